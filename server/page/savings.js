// What upscaling saves: for each clip a table of bitrates at the target, percentages saved, and BD-rate. A cell without a number
// refers to its reason below the table.

import { element } from "./dom.js";
import { NATIVE, swatch } from "./looks.js";
import { METRICS, mbps } from "./curves.js";

const BASELINE = "bicubic";

/** A table for each of the chosen clips; `savings` and `bdRates` are the service's answers. */
export function savingTables(savings, bdRates, choice, looks) {
  return choice.clips.map((clip) => {
    const shown = (item) => item.clip === clip && choice.upscalers.includes(item.series.upscaler);
    const atHeight = (item) => item.series.upscaler === NATIVE || item.series.low_height === choice.height;
    const rows = savings.savings.filter((item) => shown(item) && atHeight(item));
    const rates = bdRates.bd_rates.filter((item) => item.clip === clip && atHeight(item));
    return table(clip, rows, rates, savings, looks);
  });
}

function table(clip, rows, rates, { metric, target }, looks) {
  const notes = new Notes(clip);
  const name = METRICS[metric].name;
  const body = rows.map((row) => {
    const against = (anchor) =>
      rates.find((rate) => rate.series.upscaler === row.series.upscaler && rate.anchor.upscaler === anchor)?.bd_rate_percent[metric] ?? null;
    return element(
      "tr",
      {},
      element("th", { scope: "row" }, swatch(looks.get(row.series.upscaler)), row.series.label),
      notes.cell(row.bitrate_kbps, mbps),
      notes.cell(row.over_native_percent, percent),
      notes.cell(row.over_bicubic_percent, percent),
      notes.cell(against(NATIVE), signedPercent),
      notes.cell(against(BASELINE), signedPercent),
    );
  });
  const made = element(
    "table",
    {},
    element("caption", {}, clip),
    element(
      "thead",
      {},
      element(
        "tr",
        {},
        head("Upscaler", { rowSpan: 2, scope: "col" }),
        head("Mbit/s", { rowSpan: 2, scope: "col" }),
        head(`Bits saved at ${name} ${target} over`, { colSpan: 2, scope: "colgroup" }),
        head(`BD-rate (${name}) over`, { colSpan: 2, scope: "colgroup" }),
      ),
      element("tr", {}, ...["native", BASELINE, "native", BASELINE].map((text) => head(text, { scope: "col" }))),
    ),
    element("tbody", {}, ...body),
  );
  return element("div", { className: "figures" }, made, notes.list());
}

/** Reasons, each once, and the cells that refer to them by number. */
class Notes {
  #clip;
  #reasons = [];

  constructor(clip) {
    this.#clip = clip;
  }

  /** A cell for a figure of the service; null is nothing to say. */
  cell(figure, form) {
    if (figure === null) return element("td", { className: "none" }, "–");
    if (figure.undefined === null) return element("td", {}, form(figure.value));
    if (!this.#reasons.includes(figure.undefined)) this.#reasons.push(figure.undefined);
    const number = this.#reasons.indexOf(figure.undefined) + 1;
    const link = element("a", { href: `#${this.#id(number)}`, title: figure.undefined, "aria-label": `undefined: ${figure.undefined}` });
    link.append(`(${number})`);
    return element("td", { className: "none" }, link);
  }

  list() {
    const items = this.#reasons.map((reason, index) => element("li", { id: this.#id(index + 1) }, `(${index + 1}) ${reason}`));
    return element("ul", { className: "notes" }, ...items);
  }

  #id(number) {
    return `why-${encodeURIComponent(this.#clip)}-${number}`;
  }
}

function head(text, properties) {
  return element("th", properties, text);
}

function percent(value) {
  return `${value.toFixed(1).replace("-", "−")}%`;
}

function signedPercent(value) {
  return value > 0 ? `+${percent(value)}` : percent(value);
}
