// The network: boxes with levels, ribbons as wide as their flows, loops as loops. One diagram shows one scene.

import { colourOf, content, contentsOf, substanceOf } from "./contents.js";
import { draw, make } from "./elements.js";
import { figure, measured } from "./figures.js";
import { endsOf, frameOf, headOf, labelAt, lineOf } from "./ribbons.js";
import { still } from "./clock.js";

const NARROW = 560;
/** The least scale at which labels are read; what is wider than the page is shown whole, and large at a button. */
export const LEAST = 0.78;
const LETTER = 5.9;
const NAMED = 6.9;
const LINE = 12.5;
const WORTH = 0.012;
const SMOOTH = 260;
const CLASSES = { "-1": "lowers", 0: "other", 1: "raises" };

/** What the boxes and ribbons of a sketch hold and carry in a scene at a step. */
export function amounts(story, scene, sketch, step) {
  const { nodes } = story.networks[scene.network];
  const sum = (members, of) => members.reduce((total, i) => total + (of(i) ?? 0), 0);
  return {
    boxes: sketch.boxes.map((box) => {
      const known = box.members.every((i) => scene.levels[i][nodes[i].stores ? step : step - 1] !== null);
      const held = sum(box.members, (i) => scene.levels[i][nodes[i].stores ? step : step - 1]);
      const scale = sum(box.members, (i) => nodes[i].scale);
      return { held: known && box.members.length ? held : null, full: Math.max(held, 0) / (Math.max(held, 0) + scale || 1) };
    }),
    ribbons: sketch.ribbons.map((ribbon) => sum(ribbon.members, (k) => scene.flows[k][step - 1])),
  };
}

/** What a ribbon does to λ: −1 lowers it, +1 raises it, 0 neither, or both. */
export function signOf(network, ribbon) {
  const signs = new Set(ribbon.members.map((k) => network.arcs[k].sign));
  return signs.size === 1 ? [...signs][0] : 0;
}

/** What a box or ribbon is called. */
export function nameOf(network, sketch, kind, place) {
  const named = (b) => sketch.boxes[b].label;
  if (kind === "box") return named(place);
  const { members, donor, recipient } = sketch.ribbons[place];
  const label = members.length === 1 ? network.arcs[members[0]].label : `${members.length} flows`;
  return `${label}, from ${named(donor)} to ${named(recipient)}`;
}

/** Makes a diagram in a host element; `told` hears what is pointed at, focused, chosen and opened. */
export function diagramOf(host, story, scene, sketch, told) {
  const network = story.networks[scene.network];
  const units = { true: story.mass, false: `${story.mass}/${story.time}` };
  let frame = null;
  let items = [];
  let parts = null;
  let flowing = null;
  let going = 0;
  let large = false;

  function build(room) {
    frame = frameOf(sketch, room < NARROW ? "standing" : "lying", room);
    const [width, height] = frame.size;
    const ribbons = sketch.ribbons.map((ribbon, k) => {
      const look = CLASSES[signOf(network, ribbon)];
      const shapes = { hit: draw("path", { class: "hit" }), line: draw("path", { class: "line" }), head: draw("polygon", { class: "head" }) };
      return { ...shapes, item: option("ribbon", k, look, [shapes.hit, shapes.line, shapes.head]) };
    });
    const boxes = sketch.boxes.map((box, b) => boxOf(box, b));
    const labels = sketch.ribbons.map(() => draw("text", { class: "amount" }));
    items = [...boxes, ...ribbons].map((each) => each.item);
    items.forEach((item, i) => item.setAttribute("tabindex", i ? -1 : 0));
    parts = { ribbons, boxes, labels };
    const svg = draw(
      "svg",
      { viewBox: `0 0 ${width} ${height}`, role: "listbox", "aria-label": `Network, ${scene.name}`, "aria-orientation": "horizontal", onkeydown: move },
      draw("g", { role: "none" }, ...ribbons.map((each) => each.item)),
      draw("g", { role: "none" }, ...boxes.map((each) => each.item)),
      draw("g", { "aria-hidden": "true", class: "amounts" }, ...labels),
    );
    svg.style.maxWidth = `${Math.round(width * 1.15)}px`;
    const least = Math.round(width * LEAST);
    host.replaceChildren(...(room < least ? [sizes(svg, least)] : []), svg);
    flowing = null;
  }

  /** The button that shows a wide diagram so large that labels are read, around its broadest box, and whole again. */
  function sizes(svg, least) {
    const button = make("button", { type: "button", class: "size" });
    const broadest = frame.boxes.reduce((one, two) => (two.breadth > one.breadth ? two : one));
    const show = () => {
      button.textContent = large ? "Show all of it" : "Enlarge";
      svg.style.minWidth = large ? `${least}px` : "0";
      const centre = ((frame.lying ? broadest.centre : broadest.at) / frame.size[0]) * least;
      host.scrollLeft = large ? centre - host.clientWidth / 2 : 0;
    };
    button.addEventListener("click", () => {
      large = !large;
      show();
    });
    window.requestAnimationFrame(show);
    return button;
  }

  function option(kind, place, look, children) {
    const tell = () => told.look(kind, place);
    const listeners = { onpointerenter: tell, onfocus: tell, onclick: () => told.choose(kind, place) };
    return draw("g", { role: "option", "aria-selected": "false", class: `${kind} ${look}`, "data-kind": kind, "data-place": place, ...listeners }, ...children);
  }

  function boxOf(box, b) {
    const { begin, at, breadth, centre } = frame.boxes[b];
    const [x, y, w, h] = frame.lying ? [begin, at - breadth / 2, frame.box, breadth] : [at - breadth / 2, begin, breadth, frame.box];
    const level = draw("rect", { class: "level", x, width: w, y: y + h, height: 0, rx: 2 });
    const body = draw("rect", { class: "body", x, y, width: w, height: h, rx: 2 });
    const amount = draw("text", { class: "held" });
    const texts = [...frame.labels[b].map((line) => draw("text", { class: "name" }, line)), amount];
    const top = frame.lying ? y - 5 - LINE * (texts.length - 1) : y + h / 2 - (LINE * (texts.length - 1)) / 2 + 4;
    texts.forEach((text, i) => {
      text.setAttribute("x", frame.lying ? centre : at);
      text.setAttribute("y", top + LINE * i);
    });
    const look = `${box.role}${box.stores ? "" : " passing"}${box.opens ? " folded" : ""}`;
    const area = { x, y, w, h, text: { x: frame.lying ? centre : at, y: top - LINE, h: LINE * texts.length, lines: frame.labels[b] } };
    const wide = Math.max(w, NAMED * Math.max(...frame.labels[b].map((line) => line.length)));
    const first = Math.min(y, top - LINE);
    const hit = draw("rect", { class: "hit", x: area.text.x - wide / 2, y: first, width: wide, height: y + h - first });
    return { level, amount, area, item: option("box", b, look, [hit, body, level, ...texts]) };
  }

  function move(event) {
    const at = items.indexOf(event.target.closest("[role=option]"));
    const ahead = { ArrowRight: at + 1, ArrowDown: at + 1, ArrowLeft: at - 1, ArrowUp: at - 1, Home: 0, End: items.length - 1 };
    if (event.key in ahead) {
      const next = (ahead[event.key] + items.length) % items.length;
      items[at].setAttribute("tabindex", -1);
      items[next].setAttribute("tabindex", 0);
      items[next].focus();
    } else if (event.key === "Enter" || event.key === " ") {
      told.choose(items[at].dataset.kind, Number(items[at].dataset.place));
    } else return;
    event.preventDefault();
  }

  function ribbonsAt(flows) {
    const ends = endsOf(sketch, frame, flows);
    parts.ribbons.forEach(({ hit, line, head }, k) => {
      const path = lineOf(frame, k, ends[k]);
      line.setAttribute("d", path);
      line.setAttribute("stroke-width", ends[k].width.toFixed(2));
      hit.setAttribute("d", path);
      hit.setAttribute("stroke-width", Math.max(12, ends[k].width).toFixed(1));
      head.setAttribute("points", headOf(frame, k, ends[k]));
    });
    return ends;
  }

  function label(flows, ends) {
    const taken = parts.boxes.flatMap(({ area }) => {
      const wide = NAMED * Math.max(...area.text.lines.map((line) => line.length), 6);
      return [area, { x: area.text.x - wide / 2, y: area.text.y, w: wide, h: area.text.h }];
    });
    const most = Math.max(...flows.map(Math.abs), 1e-300);
    const order = flows.map((flow, k) => k).sort((one, two) => Math.abs(flows[two]) - Math.abs(flows[one]));
    for (const k of order) {
      const text = figure(flows[k]);
      const [along, across] = labelAt(frame, k, ends[k]);
      const [x, y] = frame.lying ? [along, across] : [across, along];
      const [w, h] = [LETTER * text.length + 4, 12];
      const raised = ends[k].width < 13 ? [-8, 8 + ends[k].width, 0] : [0, -14, 14];
      const free = (dy) => !taken.some((box) => x - w / 2 < box.x + box.w && box.x < x + w / 2 && y + dy - h / 2 < box.y + box.h && box.y < y + dy + h / 2);
      const dy = Math.abs(flows[k]) > WORTH * most ? raised.find(free) : undefined;
      parts.labels[k].textContent = dy === undefined ? "" : text;
      if (dy === undefined) continue;
      parts.labels[k].setAttribute("x", x);
      parts.labels[k].setAttribute("y", y + dy + 3.6);
      taken.push({ x: x - w / 2, y: y + dy - h / 2, w, h });
    }
  }

  function glide(target) {
    window.cancelAnimationFrame(going);
    const from = flowing;
    if (!from || still() || target.length > 400) {
      flowing = target;
      label(target, ribbonsAt(target));
      return;
    }
    const begin = performance.now();
    const frames = (now) => {
      const done = Math.min(1, (now - begin) / SMOOTH);
      const eased = done * (2 - done);
      flowing = done < 1 ? target.map((value, k) => from[k] + (value - from[k]) * eased) : target;
      ribbonsAt(flowing);
      if (done < 1) going = window.requestAnimationFrame(frames);
    };
    label(target, endsOf(sketch, frame, target));
    going = window.requestAnimationFrame(frames);
  }

  /** Gives boxes and ribbons the colours of the contents of a substance, or their own; returns what to say of each. */
  function tint(step, id) {
    const substance = substanceOf(network, id);
    const found = substance ? contentsOf(story, scene, sketch, step, id) : null;
    const say = (part) => (substance ? `, ${substance.label} ${content(part)}` : "");
    for (const [kind, name] of [["boxes", "--b"], ["ribbons", "--r"]]) {
      parts[kind].forEach(({ item }, i) => {
        if (found) item.style.setProperty(name, colourOf(substance, found[kind][i]));
        else item.style.removeProperty(name);
      });
    }
    return { box: (b) => say(found?.boxes[b]), ribbon: (k) => say(found?.ribbons[k]) };
  }

  function update(step, id) {
    const said = tint(step, id);
    const now = amounts(story, scene, sketch, step);
    parts.boxes.forEach(({ level, amount, area, item }, b) => {
      const box = sketch.boxes[b];
      const height = box.stores ? area.h * now.boxes[b].full : 0;
      level.setAttribute("y", area.y + area.h - height);
      level.setAttribute("height", height);
      amount.textContent = now.boxes[b].held === null ? "" : figure(now.boxes[b].held);
      const opens = box.opens ? ", a group: Enter opens it" : "";
      const what = `${box.stores ? "holds" : "passes on"} ${measured(now.boxes[b].held, units[box.stores])}`;
      item.setAttribute("aria-label", `${nameOf(network, sketch, "box", b)}, ${what}${said.box(b)}${opens}`);
    });
    parts.ribbons.forEach(({ item }, k) => {
      const name = nameOf(network, sketch, "ribbon", k);
      item.setAttribute("aria-label", `${name}, ${measured(now.ribbons[k], units.false)}${said.ribbon(k)}`);
      item.setAttribute("data-flow", now.ribbons[k]);
    });
    glide(now.ribbons);
  }

  function mark(kind, place) {
    for (const item of items) {
      const chosen = item.dataset.kind === kind && Number(item.dataset.place) === place;
      item.setAttribute("aria-selected", chosen);
    }
  }

  return { build, update, mark };
}
