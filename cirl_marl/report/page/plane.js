// Service against circularity: where policies and plans are, and what is proved out of reach.

import { draw, make } from "./elements.js";
import { figure, percent, ticks } from "./figures.js";
import { inkOf } from "./curves.js";

const EDGE = { top: 14, right: 16, bottom: 42, left: 64 };
const HEIGHT = 340;

/** Draws the points of a story, and returns what draws them anew for another width. */
export function planeOf(host, story) {
  const names = [...new Set(story.points.map((point) => point.name))];
  const key = make("ul", { class: "values" }, ...names.map((name, i) => make("li", {}, markOf(i), name)));
  if (story.front.length) key.append(make("li", {}, ruleOf(), "bound: from a middle start nothing reaches above it"));
  const stage = make("div", { class: "chart" });
  host.append(key, stage);
  const spread = (values, least) => {
    const [low, high] = [Math.min(...values), Math.max(...values)];
    const pad = Math.max((high - low) * 0.08, (least - (high - low)) / 2, 1e-9);
    return [low - pad, high + pad];
  };
  const services = [...story.points.map((each) => each.service), ...story.front.map(([service]) => service)];
  const lambdas = [...story.points.map((each) => each.lambda), ...story.front.map(([, lambda]) => lambda)];
  const [left, right] = spread(services, 0.02);
  const [low, high] = spread(lambdas, 0.05 * Math.max(...lambdas.map(Math.abs)));

  return function build() {
    const width = Math.max(280, stage.clientWidth);
    const x = (value) => EDGE.left + ((width - EDGE.left - EDGE.right) * (value - left)) / (right - left);
    const y = (value) => EDGE.top + ((HEIGHT - EDGE.top - EDGE.bottom) * (high - value)) / (high - low);
    const label = `λ̄ against service of ${names.join(", ")}; the figures are in the table`;
    const svg = draw("svg", { viewBox: `0 0 ${width} ${HEIGHT}`, width, height: HEIGHT, role: "img", "aria-label": label });
    for (const at of ticks(low, high, 5)) {
      svg.append(draw("line", { class: "grid", x1: EDGE.left, x2: width - EDGE.right, y1: y(at), y2: y(at) }));
      svg.append(draw("text", { class: "tick end", x: EDGE.left - 7, y: y(at) + 3.5 }, figure(at)));
    }
    for (const at of ticks(left, right, width / 110)) {
      svg.append(draw("text", { class: "tick middle", x: x(at), y: HEIGHT - 24 }, percent(at)));
    }
    svg.append(draw("text", { class: "axis end", x: width - EDGE.right, y: HEIGHT - 6 }, "mean level of the service that lacks most →"));
    svg.append(draw("text", { class: "axis", x: 4, y: 11 }, `λ̄ / ${story.mass}`));
    if (story.front.length) svg.append(...frontOf(story.front, x, y, right, high));
    story.points.forEach((point) => {
      const mark = draw("circle", { class: `spot ${inkOf(names.indexOf(point.name)).class}`, cx: x(point.service), cy: y(point.lambda), r: 5.5 });
      const said = `${point.name}${point.about ? `, ${point.about}` : ""}: λ̄ ${figure(point.lambda)} ${story.mass}, service ${percent(point.service)}`;
      mark.append(draw("title", {}, said));
      svg.append(mark);
    });
    stage.replaceChildren(svg);
  };
}

function frontOf(front, x, y, right, high) {
  const steps = front.flatMap(([service, lambda], i) => {
    const next = i + 1 < front.length ? front[i + 1][0] : right;
    return [[x(service), y(lambda)], [x(next), y(lambda)]];
  });
  const line = steps.map(([a, b]) => `${a.toFixed(1)},${b.toFixed(1)}`);
  const above = [`${steps.at(-1)[0].toFixed(1)},${y(high).toFixed(1)}`, `${steps[0][0].toFixed(1)},${y(high).toFixed(1)}`];
  return [draw("polygon", { class: "beyond", points: [...line, ...above].join(" ") }), draw("polyline", { class: "front", points: line.join(" ") })];
}

function markOf(i) {
  return draw("svg", { class: "swatch", viewBox: "0 0 12 12", width: 12, height: 12, "aria-hidden": "true" }, draw("circle", { class: `spot ${inkOf(i).class}`, cx: 6, cy: 6, r: 5 }));
}

function ruleOf() {
  return draw("svg", { class: "swatch", viewBox: "0 0 22 12", width: 22, height: 12, "aria-hidden": "true" }, draw("line", { class: "front", x1: 0, x2: 22, y1: 6, y2: 6 }));
}
