// Why: headings that open to sentences; what stands between asterisks is the name of an agent.

import { make } from "./elements.js";

function sentence(text) {
  return make("p", {}, ...text.split("*").map((part, i) => (i % 2 ? make("em", {}, part) : part)));
}

/** One closed part for each heading but the first, which is open. */
export function reasonsOf(reasons) {
  return reasons.map(({ title, said }, i) =>
    make("details", { class: "reasons", open: i === 0 }, make("summary", {}, title), ...said.map(sentence)),
  );
}
