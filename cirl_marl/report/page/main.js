// The page: what it knows, and what follows when the reader moves the time, chooses who acts, or opens a group.

import { agentsOf } from "./agents.js";
import { clockOf } from "./clock.js";
import { choiceOf, stepsOf, substanceOf } from "./contents.js";
import { panelOf, swatch } from "./curves.js";
import { detail, hint } from "./details.js";
import { diagramOf, LEAST } from "./diagram.js";
import { make, part, shown } from "./elements.js";
import { measured } from "./figures.js";
import { frameOf } from "./ribbons.js";
import { planeOf } from "./plane.js";
import { reasonsOf } from "./reasons.js";
import { figuresOf, outcomeOf } from "./tables.js";

const BESIDE = 4;
const story = JSON.parse(part("data").textContent);
const state = { scene: Math.min(1, story.scenes.length - 1), beside: false, group: "", step: 1, chosen: null, substance: "" };
let diagrams = [];
let panels = [];
let redraws = [];
let time = null;

function heading() {
  const scenario = story.scenario === "default" ? "" : `, scenario ${story.scenario}`;
  part("kicker").textContent = `${story.name}${scenario} · ${story.material}`;
  part("title").textContent = story.title;
  const { labels } = story.clock;
  const span = labels.length ? `From ${labels[0]} to ${labels.at(-1)} in ${labels.length} steps. ` : "";
  const counted = `Circularity λ is a mass, in ${story.mass}: what is regained, minus what is extracted and lost. A closed loop has λ = 0.`;
  part("standfirst").textContent = span + counted;
  const made = `${story.made.versions.join(", ")}; definition ${story.made.definition.slice(0, 12)}`;
  const about = story.scenes.find((scene) => scene.about)?.about;
  part("footer").append(
    ...[...story.notes, about ? `Bands: ${about}.` : ""].filter(Boolean).map((note) => make("p", {}, note)),
    ...story.references.map((reference) => make("p", {}, `Source: ${reference}`)),
    make("p", {}, `Made by ${made}.`),
  );
}

function sketchOf(scene) {
  const { sketches } = story.networks[scene.network];
  return sketches.find((each) => each.group === state.group) ?? sketches[0];
}

function stages() {
  const chosen = state.beside ? story.scenes.slice(0, BESIDE).map((scene, i) => i) : [state.scene];
  const needed = Math.max(...chosen.map((i) => LEAST * frameOf(sketchOf(story.scenes[i]), "lying", 0).size[0]));
  part("stages").style.gridTemplateColumns = `repeat(auto-fit, minmax(min(100%, ${Math.round(needed)}px), 1fr))`;
  diagrams = chosen.map((i) => {
    const scene = story.scenes[i];
    const sketch = sketchOf(scene);
    const host = make("div", { class: "stage" });
    const title = make("h3", { class: "who-acts" }, swatch(i), ` ${scene.name}`);
    const told = {
      look: (kind, place) => look(scene, sketch, kind, place),
      choose: (kind, place) => choose(scene, sketch, kind, place),
    };
    return { host, panel: make("div", {}, title, host), sketch, drawn: diagramOf(host, story, scene, sketch, told) };
  });
  part("stages").replaceChildren(...diagrams.map((each) => each.panel));
  build();
  path();
}

function build() {
  for (const each of diagrams) {
    each.drawn.build(each.host.clientWidth);
    each.drawn.update(state.step, state.substance);
    mark(each);
  }
}

function look(scene, sketch, kind, place) {
  state.chosen = { scene, sketch, kind, place };
  part("details").setAttribute("aria-live", "polite");
  detail(story, scene.network, sketch, kind, place, state.step);
  diagrams.forEach(mark);
}

function mark({ drawn, sketch }) {
  if (state.chosen?.sketch === sketch) drawn.mark(state.chosen.kind, state.chosen.place);
}

function choose(scene, sketch, kind, place) {
  const opens = kind === "box" ? sketch.boxes[place].opens : "";
  if (opens) open(opens);
  else look(scene, sketch, kind, place);
}

function open(group) {
  state.group = group;
  state.chosen = null;
  hint();
  stages();
  part("stages").querySelector("[tabindex='0']")?.focus();
}

function path() {
  const place = part("path");
  place.hidden = !state.group;
  if (!state.group) return;
  const back = make("button", { type: "button" }, "← All groups");
  back.addEventListener("click", () => open(""));
  place.replaceChildren(back, ` ${state.group}`);
}

function who() {
  const host = part("who");
  story.scenes.forEach((scene, i) => {
    const input = make("input", { type: "radio", name: "scene", id: `scene${i}`, value: i, checked: i === state.scene });
    input.addEventListener("change", () => {
      Object.assign(state, { scene: i, beside: false });
      stages();
    });
    host.append(make("label", { for: `scene${i}` }, input, swatch(i), make("span", {}, scene.name)));
  });
  if (story.scenes.length < 2) {
    host.hidden = true;
    return;
  }
  const input = make("input", { type: "radio", name: "scene", id: "beside", value: "beside" });
  input.addEventListener("change", () => {
    state.beside = true;
    stages();
  });
  const most = story.scenes.length > BESIDE ? `the first ${BESIDE} ` : "";
  host.append(make("label", { for: "beside" }, input, make("span", {}, `${most}side by side`)));
}

function legend() {
  const { nodes, arcs } = story.networks[0];
  const roles = [...new Set(nodes.map((node) => node.role))];
  const effects = { "-1": ["lowers", "flow that lowers λ"], 1: ["raises", "flow that raises λ"], 0: ["other", "other flow"] };
  const most = Math.max(0, ...story.scenes.flatMap((scene) => scene.flows.flatMap((flow) => flow.map(Math.abs))));
  const item = (look, name) => make("li", {}, make("i", { class: `key ${look}` }), name);
  const substance = story.networks.map((network) => substanceOf(network, state.substance)).find(Boolean);
  const meanings = substance ? stepsOf(substance) : [
      ...Object.entries(effects).filter(([sign]) => arcs.some((arc) => arc.sign === Number(sign))).map(([, [look, name]]) => item(look, name)),
      ...roles.map((role) => item(role, role.replaceAll("_", " ").replace("nonrenewable", "non-renewable"))),
  ];
  part("legend").replaceChildren(
    make("ul", {}, ...meanings),
    make("p", {}, `Ribbons are as wide as their flows, in ${story.mass}/${story.time}; the largest is ${measured(most, `${story.mass}/${story.time}`)}. Boxes fill with their stocks, in ${story.mass}: half full is the reference stock.`, nodes.every((node) => node.stores) ? "" : " Dashed boxes store nothing."),
  );
}

function curves() {
  shown("curves");
  const key = part("curves-key");
  story.scenes.forEach((scene, i) => key.append(make("span", {}, swatch(i), ` ${scene.name}`), " "));
  const { labels } = story.clock;
  const go = time.go;
  const of = (pick) => story.scenes.flatMap((scene, i) => (pick(scene) ? [{ name: scene.name, ink: i, ...pick(scene) }] : []));
  const host = part("curves-panels");
  panels.push(panelOf(host, { title: "Circularity λ", unit: story.mass, lines: of((scene) => scene.lambda), labels, go }));
  const services = new Map(story.networks.flatMap((network) => network.services.map((each) => [each.id, each.label])));
  for (const [id, label] of services) {
    const pick = (scene) => scene.services[story.networks[scene.network].services.findIndex((each) => each.id === id)];
    panels.push(panelOf(host, { title: `Service: ${label}`, share: true, lines: of(pick), limits: [0.95, 1], labels, go }));
  }
  const units = new Map(story.networks.flatMap((network) => network.disturbances.map((each) => [each.id, each.unit])));
  for (const [id, unit] of units) {
    const pick = (scene) => scene.disturbances[story.networks[scene.network].disturbances.findIndex((each) => each.id === id)];
    panels.push(panelOf(host, { title: `Disturbance: ${id.replaceAll("_", " ")}`, unit, lines: of(pick), labels, go }));
  }
  const plan = story.scenes.find((scene) => scene.plan);
  if (plan && story.scenes.length > 1) {
    const less = (values) => values?.map((value, t) => (value === null ? null : plan.lambda.value[t] - value));
    const behind = (scene) => (scene === plan ? null : { value: less(scene.lambda.value), low: less(scene.lambda.high), high: less(scene.lambda.low) });
    panels.push(panelOf(host, { title: `λ behind the ${plan.name}`, unit: story.mass, lines: of(behind), limits: [0], labels, go }));
  }
  const bounded = of((scene) => {
    const [most] = scene.figures.bound ?? [];
    const less = (values) => values?.map((value) => (value === null ? null : most - value));
    return most === undefined || most === null ? null : { value: less(scene.lambda.value), low: less(scene.lambda.high), high: less(scene.lambda.low) };
  });
  if (bounded.length) {
    const title = "λ behind the bound on its mean";
    panels.push(panelOf(host, { title, unit: `${story.mass}; the mean of this is the gap`, lines: bounded, limits: [0], labels, go }));
  }
}

function moved(step) {
  state.step = step;
  part("details").setAttribute("aria-live", "off"); // while time moves nobody wants every step read out
  for (const each of diagrams) each.drawn.update(step, state.substance);
  for (const each of panels) each.update(step);
  redraws.forEach((each) => each(step));
  if (state.chosen) detail(story, state.chosen.scene.network, state.chosen.sketch, state.chosen.kind, state.chosen.place, step);
}

function resized() {
  let width = window.innerWidth;
  let waiting = 0;
  window.addEventListener("resize", () => {
    window.cancelAnimationFrame(waiting);
    if (window.innerWidth === width) return;
    waiting = window.requestAnimationFrame(() => {
      width = window.innerWidth;
      build();
      panels.forEach((each) => each.build());
      plane?.();
    });
  });
}

heading();
outcomeOf(story);
let plane = null;
const fill = figuresOf(story, story.name);
if (story.scenes.length) {
  shown("network");
  shown("timed");
  who();
  choiceOf(story, (id) => {
    state.substance = id;
    legend();
    for (const each of diagrams) each.drawn.update(state.step, id);
  });
  legend();
  hint();
  time = clockOf(story.clock.labels, moved);
  stages();
  curves();
  const { network } = story.scenes[state.scene];
  panels.push(...agentsOf(story, network, (step) => time.go(step ?? state.step)));
  panels.forEach((each) => each.build());
  redraws = [fill];
  time.show();
} else {
  fill();
}
if (story.points.length) {
  shown("plane");
  plane = planeOf(part("plane-chart"), story);
  plane();
}
if (story.reasons.length) {
  shown("reasons");
  part("reasons-told").append(...reasonsOf(story.reasons));
}
resized();
