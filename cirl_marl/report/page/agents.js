// Agents and what they set: a panel for each, first those that differ most from the first scene.

import { make, part, shown } from "./elements.js";
import { panelOf } from "./curves.js";

const FIRST = 12;
const KINDS = { rate: "factor on its flow", flow: "flow ordered", share: "share", stretch: "factor on its lifetime", input: "" };

/** Makes the panels of one network's agents, and returns them; none where no scene tells its controls. */
export function agentsOf(story, network, go) {
  const { settings } = story.networks[network];
  const scenes = story.scenes.map((scene, i) => ({ ...scene, ink: i })).filter((scene) => scene.controls && scene.network === network);
  if (!scenes.length || !settings.length) return [];
  const ranked = [...settings].sort((one, two) => change(scenes, two) - change(scenes, one));
  shown("agents");
  const host = part("agents-panels");
  const panels = [];
  const add = (found) => {
    for (const setting of found) panels.push(panelOf(host, panel(story, setting, scenes, go)));
  };
  add(ranked.slice(0, FIRST));
  const note = part("agents-note");
  note.textContent = `${settings.length} settings of ${new Set(settings.map((each) => each.agent)).size} agents`;
  note.append(scenes.length > 1 ? ", first those that differ most from the first." : ".");
  if (ranked.length > FIRST) {
    const more = make("button", { type: "button" }, `Show the other ${ranked.length - FIRST}`);
    more.addEventListener("click", () => {
      const before = panels.length;
      add(ranked.slice(FIRST));
      panels.slice(before).forEach((each) => each.build());
      more.remove();
      go(null);
    });
    note.append(" ", more);
  }
  return panels;
}

function panel(story, setting, scenes, go) {
  const share = ["share", "transfer"].includes(setting.kind);
  const flat = (bound) => (Array.isArray(bound) ? bound : [bound]).filter((value) => value !== null);
  const unit = setting.unit === "1" ? "" : setting.unit;
  const lines = scenes.map((scene) => ({ name: scene.name, ink: scene.ink, value: scene.controls[setting.row] }));
  const kind = [share ? `share of ${setting.of}` : KINDS[setting.kind], unit].filter(Boolean).join(", ");
  const limits = [Math.min(...flat(setting.low)), Math.max(...flat(setting.high))].filter(Number.isFinite);
  return { title: setting.name, unit: kind, lines, labels: story.clock.labels, share, limits, height: 110, go };
}

function change(scenes, setting) {
  const [first, ...others] = scenes.map((scene) => scene.controls[setting.row]);
  const ends = [setting.low, setting.high].map((bound) => (Array.isArray(bound) ? bound[0] : bound));
  const width = Math.abs(ends[1] - ends[0]) || 1;
  const apart = (values) => values.reduce((sum, value, t) => sum + Math.abs(value - first[t]), 0) / width;
  return Math.max(0, ...others.map(apart));
}
