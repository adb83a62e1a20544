// Elements of HTML and SVG. Text goes in as text: nothing here, or elsewhere on the page, parses markup.

const SVG = "http://www.w3.org/2000/svg";

function filled(element, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === undefined || value === null || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else element.setAttribute(name, value === true ? "" : String(value));
  }
  element.append(...children.filter((child) => child !== null && child !== undefined && child !== ""));
  return element;
}

/** An element of HTML; attributes that begin with "on" are listeners, children are elements or text. */
export function make(tag, attributes = {}, ...children) {
  return filled(document.createElement(tag), attributes, children);
}

/** An element of SVG, likewise. */
export function draw(tag, attributes = {}, ...children) {
  return filled(document.createElementNS(SVG, tag), attributes, children);
}

/** The element of the template with this id. */
export function part(id) {
  return document.getElementById(id);
}

/** Shows a section that the template hides. */
export function shown(id) {
  part(id).hidden = false;
}

/** A table of rows of texts and elements, each row headed by its first cell; cells of numbers stand to the right. */
export function tableOf(caption, header, rows) {
  const attributes = (i) => (i ? { class: "figure", "data-column": header[i] } : { class: "", scope: "row" });
  const cell = (value, i, tag) => make(tag, attributes(i), value);
  return make(
    "table",
    {},
    make("caption", {}, caption),
    make("thead", {}, make("tr", {}, ...header.map((name, i) => make("th", { scope: "col", class: i ? "figure" : "" }, name)))),
    make("tbody", {}, ...rows.map((row) => make("tr", {}, ...row.map((value, i) => cell(value, i, i ? "td" : "th"))))),
  );
}
