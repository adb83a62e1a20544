// What is in it: the content of a substance in boxes and ribbons, and the colours that show it.

import { make, part } from "./elements.js";
import { figure } from "./figures.js";

/** The substance of a network with this id, or undefined. */
export function substanceOf(network, id) {
  return network.substances.find((each) => each.id === id);
}

/** The contents of a substance in the boxes and ribbons of a sketch in a scene at a step; null where there is nothing. */
export function contentsOf(story, scene, sketch, step, id) {
  const network = story.networks[scene.network];
  const rows = scene.contents[network.substances.findIndex((each) => each.id === id)];
  const mean = (members, row, amount) => {
    const whole = members.reduce((sum, i) => sum + (amount(i) ?? 0), 0);
    const within = members.reduce((sum, i) => sum + (amount(i) ?? 0) * (rows[row(i)][step - 1] ?? 0), 0);
    return whole > 0 ? within / whole : null;
  };
  const level = (i) => scene.levels[i][network.nodes[i].stores ? step : step - 1];
  return {
    boxes: sketch.boxes.map((box) => mean(box.members, (i) => i, level)),
    ribbons: sketch.ribbons.map((ribbon) => mean(ribbon.members, (k) => network.nodes.length + k, (k) => scene.flows[k][step - 1])),
  };
}

/** The colour of a content between the steps of its scale; that of nothing for null. */
export function colourOf(substance, content) {
  if (content === null) return "var(--other)";
  const { steps, highest } = substance;
  const place = Math.min(content / highest, 1) * (steps.length - 1);
  const first = Math.min(Math.floor(place), steps.length - 2);
  const channel = (colour, i) => parseInt(colour.slice(i, i + 2), 16);
  const mixed = [1, 3, 5].map((i) => {
    const [from, to] = [channel(steps[first][0], i), channel(steps[first + 1][0], i)];
    return Math.round(from + (to - from) * (place - first));
  });
  return `rgb(${mixed.join(", ")})`;
}

/** A content in percent, a small one in parts per million; an en dash for that of nothing. */
export function content(value) {
  if (value === null) return "–";
  return value === 0 || value >= 1e-3 ? `${figure(100 * value)}\u00a0%` : `${figure(1e6 * value)}\u00a0ppm`;
}

/** Items of a legend that say what the colours of a substance mean. */
export function stepsOf(substance) {
  return [...substance.steps, ["var(--other)", "nothing"]].map(([colour, text]) => {
    const key = make("i", { class: "key" });
    key.style.background = colour;
    return make("li", {}, key, text);
  });
}

/** Fills the choice of what colours show, if there is one; `chosen` hears the id of a substance, or nothing. */
export function choiceOf(story, chosen) {
  const labels = new Map(story.networks.flatMap((network) => network.substances.map(({ id, label }) => [id, label])));
  if (!labels.size || !story.scenes.every((scene) => scene.contents.length)) return;
  const choice = part("tint");
  choice.append(make("option", { value: "" }, "what flows do to λ"), ...[...labels].map(([id, label]) => make("option", { value: id }, `content of ${label}`)));
  choice.addEventListener("change", () => chosen(choice.value));
  part("tints").hidden = false;
}
