// Numbers as people read them, and as spreadsheets do.

const RAISED = { "-": "⁻", 0: "⁰", 1: "¹", 2: "²", 3: "³", 4: "⁴", 5: "⁵", 6: "⁶", 7: "⁷", 8: "⁸", 9: "⁹" };

/** A value with three digits, or all that stand before the point up to six; an en dash for none. */
export function figure(value) {
  if (value === null || value === undefined) return "–";
  const size = Math.abs(value);
  if (size < 1e-9) return "0";
  if (size >= 1e-3 && size < 9_999_999.5) {
    const text = size >= 99.95 ? size.toFixed(0) : String(Number(size.toPrecision(3)));
    const [whole, fraction] = text.split(".");
    const grouped = whole.length > 4 ? whole.replace(/\B(?=(\d{3})+$)/g, "\u202f") : whole;
    return (value < 0 ? "−" : "") + grouped + (fraction ? `.${fraction}` : "");
  }
  const [mantissa, exponent] = size.toExponential(2).split("e");
  const power = String(Number(exponent)).replace(/./g, (digit) => RAISED[digit]);
  return `${value < 0 ? "−" : ""}${Number(mantissa)}×10${power}`;
}

/** A value with its unit, which is left out where it is 1. */
export function measured(value, unit) {
  return unit && unit !== "1" ? `${figure(value)}\u00a0${unit}` : figure(value);
}

/** A share as percent. */
export function percent(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const size = Math.abs(value * 100);
  const text = size >= 99.95 || size === 0 ? size.toFixed(0) : size >= 0.1 ? size.toFixed(1) : size.toPrecision(1);
  return `${value < 0 ? "−" : ""}${text}\u00a0%`;
}

/** [value, low, high] as "value [low, high]", by a form for each. */
export function ranged(found, form) {
  if (!found) return "–";
  const [value, low, high] = found;
  return low === null || high === null ? form(value) : `${form(value)} [${form(low)}, ${form(high)}]`;
}

/** Round values at which an axis from low to high has about so many lines. */
export function ticks(low, high, count) {
  const rough = (high - low) / Math.max(1, count);
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 2.5, 5, 10].map((each) => each * power).find((each) => each >= rough * 0.999);
  const first = Math.ceil(low / step - 1e-9);
  const last = Math.floor(high / step + 1e-9);
  return Array.from({ length: last - first + 1 }, (_, i) => (first + i) * step);
}

/** Rows as CSV; text that a spreadsheet would compute is marked as text. */
export function csv(rows) {
  const cell = (value) => {
    if (value === null || value === undefined) return "";
    if (typeof value === "number") return String(value);
    const text = /^[=+\-@\t\r]/.test(value) ? `'${value}` : value;
    return /[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
  };
  return `${rows.map((row) => row.map(cell).join(",")).join("\n")}\n`;
}
