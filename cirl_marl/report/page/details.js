// What is pointed at, focused or chosen: value, unit, share and source, in every scene.

import { amounts, nameOf, signOf } from "./diagram.js";
import { content, contentsOf } from "./contents.js";
import { make, part, tableOf } from "./elements.js";
import { figure, measured, percent } from "./figures.js";
import { swatch } from "./curves.js";

const ROLES = {
  nonrenewable_reservoir: "non-renewable reservoir",
  technosphere: "technosphere",
  landfill: "landfill",
  incinerator: "incinerator",
  environment: "environment",
};
const EFFECTS = { "-1": "What flows here lowers λ.", 0: "", 1: "What flows here raises λ." };

/** Shows a hint while nothing is pointed at. */
export function hint() {
  const said = "Point at a compartment or a flow, or reach the picture with Tab and walk through it with the arrow keys: its value, share and source stand here.";
  part("details").replaceChildren(make("p", { class: "hint" }, said));
}

/** Shows a box or ribbon of a sketch as it is at a step in all scenes of its network; returns its name. */
export function detail(story, network, sketch, kind, place, step) {
  const scenes = story.scenes.map((scene, i) => ({ scene, ink: i })).filter(({ scene }) => scene.network === network);
  const name = nameOf(story.networks[network], sketch, kind, place);
  const tell = kind === "box" ? boxDetail : ribbonDetail;
  const found = tell(story, network, sketch, place, step, scenes);
  const when = story.clock.labels[step - 1];
  part("details").replaceChildren(
    make("h3", {}, name),
    make("p", { class: "note" }, `${found.about} ${when}`.trim()),
    make("div", { class: "wide" }, tableOf(`${name} in ${when}`, found.header, found.rows)),
    ...sourcesOf(found.told),
  );
  return name;
}

function headed({ scene, ink }) {
  return make("span", {}, swatch(ink), ` ${scene.name}`);
}

/** The contents of all substances in a box or ribbon, as cells of a table. */
function contentCells(story, scene, sketch, step, kind, place) {
  if (!scene.contents.length) return [];
  return story.networks[scene.network].substances.map(({ id }) => content(contentsOf(story, scene, sketch, step, id)[kind][place]));
}

function contentHeads(story, network, scenes) {
  return scenes.some(({ scene }) => scene.contents.length) ? story.networks[network].substances.map(({ label }) => label) : [];
}

function boxDetail(story, network, sketch, place, step, scenes) {
  const box = sketch.boxes[place];
  const flow = `${story.mass}/${story.time}`;
  const through = (members, of) => members.reduce((sum, k) => sum + Math.abs(of[k] ?? 0), 0);
  const [into, out] = ["recipient", "donor"].map((end) => sketch.ribbons.flatMap((ribbon, k) => (ribbon[end] === place ? [k] : [])));
  const rows = scenes.map(({ scene, ink }) => {
    const now = amounts(story, scene, sketch, step);
    const held = box.stores ? [measured(now.boxes[place].held, story.mass), percent(now.boxes[place].full)] : [];
    return [headed({ scene, ink }), ...held, measured(through(into, now.ribbons), flow), measured(through(out, now.ribbons), flow), ...contentCells(story, scene, sketch, step, "boxes", place)];
  });
  const kind = box.opens ? `${box.members.length} stocks of a group` : `${ROLES[box.role]}${box.stores ? "" : ", stores nothing"}`;
  const node = box.members.length === 1 && !box.opens ? story.networks[network].nodes[box.members[0]] : null;
  const header = ["", ...(box.stores ? ["holds at the end", "full"] : []), "enters", "leaves", ...contentHeads(story, network, scenes)];
  return { about: `${kind[0].toUpperCase()}${kind.slice(1)}.`, header, rows, told: node?.told ?? [] };
}

function ribbonDetail(story, network, sketch, place, step, scenes) {
  const ribbon = sketch.ribbons[place];
  const flow = `${story.mass}/${story.time}`;
  const share = (flows, end) => {
    const all = sketch.ribbons.reduce((sum, each, k) => sum + (each[end] === ribbon[end] ? Math.abs(flows[k]) : 0), 0);
    return all > 0 ? percent(Math.abs(flows[place]) / all) : "–";
  };
  const rows = scenes.map(({ scene, ink }) => {
    const { ribbons } = amounts(story, scene, sketch, step);
    const total = ribbon.members.reduce((sum, k) => sum + scene.flows[k].reduce((all, value) => all + (value ?? 0), 0), 0);
    const values = [measured(ribbons[place], flow), share(ribbons, "donor"), share(ribbons, "recipient"), figure(total * story.interval), ...contentCells(story, scene, sketch, step, "ribbons", place)];
    return [headed({ scene, ink }), ...values];
  });
  const header = ["", "flow", "of what leaves", "of what arrives", `in all / ${story.mass}`, ...contentHeads(story, network, scenes)];
  const arc = ribbon.members.length === 1 ? story.networks[network].arcs[ribbon.members[0]] : null;
  const effect = EFFECTS[signOf(story.networks[network], ribbon)];
  return { about: [effect, arc ? `${arc.law}.` : ""].filter(Boolean).join(" "), header, rows, told: arc?.told ?? [] };
}

function sourcesOf(told) {
  if (!told.length) return [];
  const list = make("dl", { class: "sources" });
  for (const [key, value, source] of told) {
    list.append(make("dt", {}, key.replaceAll("_", " ") || "all", value ? `: ${value}` : ""), make("dd", {}, source));
  }
  return [make("details", { open: told.length < 4 }, make("summary", {}, "Sources"), list)];
}
