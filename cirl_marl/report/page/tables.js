// Everything that is shown, as a table of one moment and as a CSV file of all of them.

import { make, part, shown, tableOf } from "./elements.js";
import { csv, figure, measured, percent, ranged } from "./figures.js";

const HEADER = ["scene", "step", "from", "to", "when", "kind", "id", "name", "value", "low", "high", "unit"];
const GROUPS = { circularity: "Circularity, service, accounts", stock: "Stocks and throughputs", flow: "Flows", control: "What agents set" };

/** Every quantity of a scene: its kind, id, name, unit and values, one for each step, and at step 0 where there is one. */
export function quantitiesOf(story, scene) {
  const { nodes, arcs, services, accounts, disturbances, settings } = story.networks[scene.network];
  const flow = `${story.mass}/${story.time}`;
  const of = (kind, id, name, unit, band) => ({ kind, id, name, unit, ...band, first: 1 });
  return [
    of("circularity", "", "λ, mean of the interval", story.mass, scene.lambda),
    ...services.map((each, s) => of("service", each.id, `service: ${each.label}`, "1", scene.services[s])),
    ...accounts.filter((_, n) => scene.accounts[n]).map((each, n) => of("account", each.id, `account: ${each.label}`, each.unit, scene.accounts[n])),
    ...disturbances.map((each, n) => of("disturbance", each.id, `disturbance: ${each.id}`, each.unit, scene.disturbances[n])),
    ...nodes.map((node, i) => {
      const about = node.stores ? ["stock", story.mass] : ["throughput", flow];
      return { ...of(about[0], node.id, node.label, about[1], { value: scene.levels[i] }), first: node.stores ? 0 : 1 };
    }),
    ...arcs.map((arc, k) => of("flow", arc.id, `${arc.label} (${nodes[arc.donor].label} → ${nodes[arc.recipient].label})`, flow, { value: scene.flows[k] })),
    ...(scene.controls ? settings : []).map((each) => of("control", each.agent, each.name, each.unit, { value: scene.controls[each.row] })),
  ];
}

/** All quantities of all scenes at all steps, as rows; then points, bound and outcomes. */
export function everything(story) {
  const rows = [HEADER];
  const { from, to, labels } = story.clock;
  for (const scene of story.scenes) {
    for (const each of quantitiesOf(story, scene)) {
      each.value.forEach((value, i) => {
        const step = i + each.first;
        const when = step ? [from[step - 1], to[step - 1], labels[step - 1]] : [from[0], from[0], "start"];
        rows.push([scene.name, step, ...when, each.kind, each.id, each.name, value, each.low?.[i], each.high?.[i], each.unit]);
      });
    }
    const empty = ["", "", "", ""];
    for (const [which, [value, low, high]] of Object.entries(scene.figures)) {
      rows.push([scene.name, ...empty, "outcome", which, which, value, low, high, unitOf(story, which)]);
    }
  }
  const point = (name, about, service, lambda) => {
    rows.push([name, "", "", "", "", "point", "service", about, service, "", "", "1"]);
    rows.push([name, "", "", "", "", "point", "circularity", about, lambda, "", "", story.mass]);
  };
  for (const each of story.points) point(each.name, each.about, each.service, each.lambda);
  for (const [service, lambda] of story.front) point("bound", "", service, lambda);
  return rows;
}

/** The accounts of all networks, one for each id. */
function accountsOf(story) {
  return [...new Map(story.networks.flatMap((network) => network.accounts).map((each) => [each.id, each])).values()];
}

/** The unit of a figure of whole episodes. */
function unitOf(story, which) {
  const account = accountsOf(story).find((each) => which === `account:${each.id}`);
  return account ? account.unit : ["circularity", "bound"].includes(which) ? story.mass : "1";
}

/** Shows what came of whole episodes. */
export function outcomeOf(story) {
  const forms = {
    circularity: [`λ̄ / ${story.mass}`, figure],
    gain: ["gain", percent],
    service: ["service level", percent],
    bound: [`bound / ${story.mass}`, figure],
    gap: ["gap to the bound", percent],
    recycling_rate: ["end-of-life recycling rate", percent],
    recycled_content: ["recycled content", percent],
    ...Object.fromEntries(accountsOf(story).map((each) => [`account:${each.id}`, [`${each.label} / ${each.unit}`, figure]])),
  };
  const there = Object.keys(forms).filter((which) => story.scenes.some((scene) => scene.figures[which]));
  if (!there.length) return;
  shown("outcome");
  const rows = story.scenes.map((scene) => [scene.name, ...there.map((which) => ranged(scene.figures[which], forms[which][1]))]);
  part("outcome-table").append(tableOf("Figures of whole episodes, with 95 % intervals", ["", ...there.map((which) => forms[which][0])], rows));
}

/** Makes the table, and returns what fills it for a step. */
export function figuresOf(story, file) {
  const save = make("button", { type: "button" }, "Download everything as CSV");
  save.addEventListener("click", () => {
    const url = URL.createObjectURL(new Blob([csv(everything(story))], { type: "text/csv" }));
    make("a", { href: url, download: `${file}.csv` }).click();
    window.setTimeout(() => URL.revokeObjectURL(url), 1000);
  });
  if (!story.scenes.length) {
    part("tools").append(save);
    const rows = [...story.points.map((each) => [each.name, each.about, percent(each.service), figure(each.lambda)]), ...story.front.map(([service, lambda]) => ["bound", "", percent(service), figure(lambda)])];
    part("figures").append(tableOf("Points", ["what", "", "service", `λ̄ / ${story.mass}`], rows));
    return () => {};
  }
  const pick = make("select", { id: "kind" }, ...Object.entries(GROUPS).map(([value, name]) => make("option", { value }, name)));
  part("tools").append(make("label", { for: "kind" }, "Show "), pick, save);
  const found = story.scenes.map((scene) => new Map(quantitiesOf(story, scene).map((each) => [`${each.kind} ${each.id} ${each.name}`, each])));
  const kinds = { circularity: ["circularity", "service", "account", "disturbance"], stock: ["stock", "throughput"], flow: ["flow"], control: ["control"] };
  let last = 1;
  const fill = (step) => {
    last = step;
    const keys = [...new Set(found.flatMap((each) => [...each.entries()].filter(([, it]) => kinds[pick.value].includes(it.kind)).map(([key]) => key)))];
    const rows = keys.map((key) => {
      const some = found.find((each) => each.has(key)).get(key);
      return [some.name, some.unit === "1" ? "" : some.unit, ...found.map((each) => bandAt(each.get(key), step))];
    });
    const caption = `${GROUPS[pick.value]}, ${story.clock.labels[step - 1]}`;
    part("figures").replaceChildren(tableOf(caption, ["", "unit", ...story.scenes.map((scene) => scene.name)], rows));
  };
  pick.addEventListener("change", () => fill(last));
  return fill;
}

function bandAt(quantity, step) {
  if (!quantity) return "–";
  const i = step - quantity.first;
  return ranged([quantity.value[i], quantity.low?.[i] ?? null, quantity.high?.[i] ?? null], (value) => measured(value, ""));
}
