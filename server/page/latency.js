// Latency as bars against the deadlines of frame rates, what the harness measured above what players' clients posted.

import { element, svg } from "./dom.js";
import { NATIVE, label } from "./looks.js";

const DEADLINES_FPS = [30, 60, 120];
const ROW = 26;
const BAR = 14;
const TOP = 34;
const BOTTOM = 36;
const LEAST_MS = 0.5;
const NAMES_BESIDE_FROM = 560; // narrower than this, names stand above their bars
const NAMES = 190;
const MOST_PLAYERS = 20; // the newest

/** One panel of bars and one table for all of `rows`, redrawn as wide as it gets. */
export class Latency {
  #holder;
  #rows = [];
  #width = 0;

  constructor(holder) {
    this.#holder = holder;
    new ResizeObserver(() => this.#width !== holder.clientWidth && this.#draw()).observe(holder);
  }

  show(measured, posted, choice) {
    this.#rows = [...measuredRows(measured, choice), ...postedRows(posted)];
    this.#draw();
  }

  #draw() {
    this.#width = this.#holder.clientWidth;
    if (!this.#width) return;
    if (!this.#rows.length) {
      this.#holder.replaceChildren(element("p", { className: "empty" }, "No latency was measured for this choice, and no client has posted any."));
      return;
    }
    this.#holder.replaceChildren(legend(this.#rows), bars(this.#rows, this.#width), table(this.#rows), ...machines(this.#rows));
  }
}

function measuredRows(measured, { clips, upscalers, height }) {
  return measured
    .filter(
      (item) =>
        clips.includes(item.clip) && upscalers.includes(item.upscaler) && (item.upscaler === NATIVE || item.low_height === height),
    )
    .map((item) => ({
      name: clips.length > 1 ? `${item.clip}: ${label(item.upscaler)}` : label(item.upscaler),
      where: `${item.threads} threads of ${item.machine}`,
      total: item.latency_us.total,
      deadlines: item.deadlines,
      live: false,
    }));
}

function postedRows(posted) {
  return posted.slice(0, MOST_PLAYERS).map((item) => ({
    name: `live: ${item.model} ${item.low_height}p`,
    where: `${item.provider}, ${item.threads} threads of ${item.machine}, ${new Date(1000 * item.received_at).toLocaleString()}`,
    total: item.latency_us.total,
    deadlines: item.deadlines,
    live: true,
  }));
}

function legend(rows) {
  const key = (kind, text) =>
    element("span", {}, svg("svg", { width: 22, height: 12, "aria-hidden": "true" }, svg("rect", { class: kind, x: 1, y: 1, width: 20, height: 10 })), text);
  const live = rows.some((row) => row.live) ? key("bar live p50", "posted by players") : "No player's client has posted what it sees.";
  return element("p", { className: "legend" }, key("bar p50", "p50"), key("bar p95", "p95"), live);
}

function bars(rows, width) {
  const beside = width >= NAMES_BESIDE_FROM;
  const [left, right] = [beside ? NAMES : 4, width - 58];
  const step = beside ? ROW : ROW + 16;
  const bottom = TOP + rows.length * step;
  const most = Math.max(1000 / Math.min(...DEADLINES_FPS), ...rows.map((row) => row.total.p95 / 1000)) * 1.25;
  const x = (ms) => left + ((right - left) * Math.log(Math.max(ms, LEAST_MS) / LEAST_MS)) / Math.log(most / LEAST_MS);
  const picture = svg("svg", {
    class: "bars",
    width,
    height: bottom + BOTTOM,
    role: "img",
    "aria-label": "Bars of p50 and p95 of a whole frame against the deadlines of 30, 60 and 120 frames a second; the table below has the numbers.",
  });
  for (const tick of [1, 3, 10, 30, 100, 300, 1000, 3000].filter((ms) => ms <= most)) {
    picture.append(
      svg("path", { class: "tick", d: `M${x(tick)},${bottom} v4` }),
      svg("text", { x: x(tick), y: bottom + 17, "text-anchor": "middle" }, String(tick)),
    );
  }
  picture.append(
    svg("path", { class: "base", d: `M${left},${bottom} H${right}` }),
    svg("text", { class: "title", x: right, y: bottom + BOTTOM - 3, "text-anchor": "end" }, "one frame, ms; in numbers: p50"),
  );
  const tops = rows.map((_, index) => TOP + index * step + (beside ? 0 : 16));
  rows.forEach((row, index) => picture.append(...bar(row, tops[index], x, left)));
  for (const fps of DEADLINES_FPS) {
    picture.append(
      svg("path", { class: "deadline", d: `M${x(1000 / fps)},${TOP - 6} V${bottom}` }),
      svg("text", { class: "deadline", x: x(1000 / fps), y: TOP - 20, "text-anchor": "middle" }, String(fps)),
      svg("text", { class: "deadline", x: x(1000 / fps), y: TOP - 9, "text-anchor": "middle" }, "fps"),
    );
  }
  rows.forEach((row, index) => picture.append(...words(row, tops[index], x, left, beside)));
  return picture;
}

function bar(row, top, x, left) {
  const y = top + (ROW - BAR) / 2;
  const kind = row.live ? "bar live" : "bar";
  return ["p95", "p50"].map((part) => svg("rect", { class: `${kind} ${part}`, x: left, y, width: x(row.total[part] / 1000) - left, height: BAR }));
}

function words(row, top, x, left, beside) {
  const base = top + ROW / 2 + 4;
  const name = beside ? { x: left - 8, y: base, "text-anchor": "end" } : { x: left, y: top + 1 };
  return [
    svg("text", { class: "over", ...name }, beside ? shortened(row.name) : row.name),
    svg("text", { class: "over", x: x(row.total.p95 / 1000) + 6, y: base }, milliseconds(row.total.p50 / 1000)),
  ];
}

function table(rows) {
  const heads = ["p50", "p95", "p99", ...DEADLINES_FPS.map((fps) => `${fps} fps`)];
  const body = rows.map((row) => {
    const missed = DEADLINES_FPS.map((fps) => row.deadlines.find((deadline) => deadline.fps === fps));
    return element(
      "tr",
      {},
      element("th", { scope: "row" }, row.name),
      ...[row.total.p50, row.total.p95, row.total.p99].map((us) => element("td", {}, milliseconds(us / 1000))),
      ...missed.map((deadline) => element("td", {}, deadline ? `${share(deadline.missed_share)}%` : "–")),
    );
  });
  return element(
    "table",
    {},
    element("caption", {}, "Percentiles, and the share of frames that missed a deadline"),
    element(
      "thead",
      {},
      element(
        "tr",
        {},
        element("th", { rowSpan: 2, scope: "col" }, "Upscaler"),
        element("th", { colSpan: 3, scope: "colgroup" }, "One frame, ms"),
        element("th", { colSpan: 3, scope: "colgroup" }, "Missed deadlines"),
      ),
      element("tr", {}, ...heads.map((text) => element("th", { scope: "col" }, text))),
    ),
    element("tbody", {}, ...body),
  );
}

/** Milliseconds mean nothing without the machine. */
function machines(rows) {
  const places = new Map();
  for (const row of rows) places.set(row.where, [...(places.get(row.where) ?? []), row]);
  return [...places].map(([where, on]) => {
    const what = on[0].live ? on.map((row) => row.name).join(", ") : "Measured by sweeps, nothing else running";
    return element("p", { className: "note" }, `${what}: ${where}.`);
  });
}

function milliseconds(ms) {
  return ms >= 100 ? ms.toFixed(0) : ms >= 10 ? ms.toFixed(1) : ms.toFixed(2);
}

/** Percent; what is neither none nor all never reads as such. */
function share(part) {
  const percent = 100 * part;
  return percent > 0 && percent < 1 ? "<1" : percent < 100 ? String(Math.min(Math.round(percent), 99)) : "100";
}

function shortened(name) {
  return name.length > 30 ? `${name.slice(0, 29)}…` : name;
}
