// Curves over time, with intervals, drawn for the width there is.

import { draw, make } from "./elements.js";
import { figure, percent, ticks } from "./figures.js";

const EDGE = { top: 10, right: 12, bottom: 24, left: 52 };

/** Kinds of ink, one for each scene: a class for its colour and a pattern of dashes. */
export function inkOf(place) {
  return { class: `ink${place % 6}`, "stroke-dasharray": ["", "7 3", "2 3", "8 3 2 3"][place % 4] };
}

/** The mark of a scene beside its name. */
export function swatch(place) {
  const line = draw("line", { x1: 0, x2: 22, y1: 6, y2: 6, ...inkOf(place) });
  return draw("svg", { class: "swatch", viewBox: "0 0 22 12", width: 22, height: 12, "aria-hidden": "true" }, line);
}

/** A panel: heading, values of now, and curves of {name, ink, value, low, high, steps}. */
export function panelOf(host, { title, unit, lines, labels, share, limits, height, go }) {
  const form = share ? percent : figure;
  const values = make("ul", { class: "values" });
  const stage = make("div", { class: "chart" });
  host.append(make("figure", {}, make("figcaption", {}, make("strong", {}, title), unit ? ` ${unit}` : "", values), stage));
  const cells = lines.map((line) => {
    const value = make("span", { class: "figure" });
    values.append(make("li", { title: line.name }, swatch(line.ink), value));
    return value;
  });
  const count = labels.length;
  const all = lines.flatMap((line) => [line.value, line.low ?? [], line.high ?? []].flat()).filter((value) => value !== null);
  let [low, high] = [Math.min(...all, ...(limits ?? [])), Math.max(...all, ...(limits ?? []))];
  if (!all.length) [low, high] = [0, 1];
  const pad = (high - low || Math.abs(high) || 1) * 0.06;
  if (high - low < 1e-9 * Math.max(Math.abs(low), Math.abs(high), 1e-300)) [low, high] = [low - 6 * pad, high + 6 * pad];
  else [low, high] = [low - pad, high + pad];
  let cursor = null;
  let dots = [];
  let step = 1;
  let place = null;

  function build() {
    const width = Math.max(220, stage.clientWidth);
    const tall = height ?? 190;
    const x = (i) => EDGE.left + ((width - EDGE.left - EDGE.right) * (count > 1 ? i / (count - 1) : 0.5));
    const y = (value) => EDGE.top + ((tall - EDGE.top - EDGE.bottom) * (high - value)) / (high - low);
    place = { x, y };
    const svg = draw("svg", { viewBox: `0 0 ${width} ${tall}`, width, height: tall, role: "img", "aria-label": summary() });
    for (const at of ticks(low, high, tall > 120 ? 4 : 3)) {
      svg.append(draw("line", { class: at === 0 ? "zero" : "grid", x1: EDGE.left, x2: width - EDGE.right, y1: y(at), y2: y(at) }));
      svg.append(draw("text", { class: "tick end", x: EDGE.left - 7, y: y(at) + 3.5 }, form(at)));
    }
    const shown = Math.max(1, Math.min(count - 1, Math.floor((width - EDGE.left) / 90)));
    for (let i = 0; i <= shown && count > 1; i += 1) {
      const at = Math.round((i * (count - 1)) / shown);
      const anchor = i === 0 ? "start" : i === shown ? "end" : "middle";
      svg.append(draw("text", { class: `tick ${anchor}`, x: x(at), y: tall - 7 }, labels[at]));
    }
    for (const line of lines) svg.append(...curveOf(line, x, y));
    cursor = draw("line", { class: "cursor", y1: EDGE.top, y2: tall - EDGE.bottom });
    dots = lines.map((line) => draw("circle", { class: inkOf(line.ink).class, r: 3 }));
    svg.append(cursor, ...dots);
    svg.addEventListener("click", (event) => {
      const at = ((event.clientX - svg.getBoundingClientRect().left - EDGE.left) / (width - EDGE.left - EDGE.right)) * (count - 1);
      go(Math.min(count, Math.max(1, Math.round(at) + 1)));
    });
    stage.replaceChildren(svg);
    update(step);
  }

  function summary() {
    const ends = lines.map(({ name, value }) => `${name} from ${form(value[0])} to ${form(value.at(-1))}`);
    return `${title}${unit ? `, ${unit}` : ""}, ${labels[0]} to ${labels.at(-1)}: ${ends.join("; ")}`;
  }

  function update(now) {
    step = now;
    const at = place.x(step - 1);
    cursor.setAttribute("x1", at);
    cursor.setAttribute("x2", at);
    lines.forEach((line, i) => {
      const value = line.value[step - 1];
      dots[i].setAttribute("cx", at);
      dots[i].setAttribute("cy", value === null ? -9 : place.y(value));
      cells[i].textContent = form(value);
    });
  }

  return { build, update };
}

function curveOf(line, x, y) {
  const path = (values) => {
    let pen = "M";
    return values.map((value, i) => {
      if (value === null) {
        pen = "M";
        return "";
      }
      const text = `${pen}${x(i).toFixed(1)} ${y(value).toFixed(1)}`;
      pen = "L";
      return text;
    }).join("");
  };
  const found = [draw("path", { ...inkOf(line.ink), class: `curve ${inkOf(line.ink).class}`, d: path(line.value) })];
  if (line.low && line.high) {
    const there = line.high.map((value, i) => `${x(i).toFixed(1)},${y(value).toFixed(1)}`);
    const back = line.low.map((value, i) => `${x(i).toFixed(1)},${y(value).toFixed(1)}`).reverse();
    found.unshift(draw("polygon", { class: `band ${inkOf(line.ink).class}`, points: [...there, ...back].join(" ") }));
  }
  return found;
}
