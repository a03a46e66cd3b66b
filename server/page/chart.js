// A rate-distortion chart: quality over true bitrate, read with a pointer or with the arrow keys.

import { svg } from "./dom.js";

const HEIGHT = 300; // as .plot of style.css
const TOP = 24;
const BOTTOM = 40;
const LEFT = 44;
const NAMES = 96; // room for names beside the last points
const NAMES_FROM = 430; // narrower than this, the legend has to do
const NAME_STEP = 15;
const NEAR = 28; // how far a pointer may be from a point to read it
const TICKS_MBPS = [0.125, 0.25, 0.5, 1, 2, 4, 8, 16, 32, 64, 128];

/**
 * Draws into `holder` again whenever that changes its width. `onRead(series, index)` is told which point is read, null for none;
 * `onPick(series, index)` which one was clicked, or Enter pressed on.
 */
export class Chart {
  #holder;
  #onRead;
  #onPick;
  #data = null;
  #places = []; // of every point: series and index, and x and y in pixels
  #read = null;
  #ring;
  #width = 0;

  constructor(holder, { onRead, onPick }) {
    this.#holder = holder;
    this.#onRead = onRead;
    this.#onPick = onPick;
    new ResizeObserver(() => this.#width !== holder.clientWidth && this.#draw()).observe(holder);
  }

  /** `series`: [{name, look, points: [{mbps, quality}]}] by rising bitrate; `grades`: [[quality, word]]; `summary` is for screen readers. */
  show(data) {
    this.#data = data;
    this.#read = null;
    this.#draw();
  }

  #draw() {
    this.#width = this.#holder.clientWidth;
    if (!this.#data || !this.#width) return;
    const { series, grades, axis, summary } = this.#data;
    const named = this.#width >= NAMES_FROM;
    const right = this.#width - (named ? NAMES : 10);
    const x = scaleX(series, LEFT, right);
    const y = scaleY(series, grades, HEIGHT - BOTTOM, TOP);
    const picture = svg("svg", {
      class: "chart",
      width: this.#width,
      height: HEIGHT,
      tabindex: 0,
      role: "group",
      "aria-roledescription": "chart",
      "aria-label": `${summary} Arrow keys read its points.`,
    });
    picture.append(axes(x, y, right, axis), gradeLines(y, grades, right));
    this.#places = [];
    for (const each of series) {
      const points = each.points.map((point, index) => ({ series: each, index, x: x.at(point.mbps), y: y.at(point.quality) }));
      picture.append(line(each.look, points));
      this.#places.push(...points);
    }
    if (named) picture.append(names(series, x, y, right));
    this.#ring = svg("circle", { class: "ring", r: 8, visibility: "hidden" });
    picture.append(this.#ring);
    picture.addEventListener("pointermove", (event) => this.#point(event));
    picture.addEventListener("pointerleave", () => this.#readPlace(null));
    picture.addEventListener("click", (event) => {
      this.#point(event);
      this.#pick();
    });
    picture.addEventListener("keydown", (event) => this.#key(event));
    const hadFocus = this.#holder.contains(document.activeElement);
    this.#holder.replaceChildren(picture);
    if (hadFocus) picture.focus();
  }

  #point(event) {
    const box = this.#holder.getBoundingClientRect();
    const [left, top] = [event.clientX - box.left, event.clientY - box.top];
    const far = (place) => Math.hypot(place.x - left, place.y - top);
    const nearest = this.#places.reduce((best, place) => (best && far(best) <= far(place) ? best : place), null);
    this.#readPlace(nearest && far(nearest) <= NEAR ? nearest : null);
  }

  #key(event) {
    const { series } = this.#data;
    if (event.key === "Enter") return this.#pick();
    const steps = { ArrowRight: [1, 0], ArrowLeft: [-1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    if (!(event.key in steps) || !this.#places.length) return;
    event.preventDefault();
    if (!this.#read) return this.#readPlace(this.#places[0]);
    const [along, across] = steps[event.key];
    const others = series.filter((each) => each.points.length);
    const next = others[clamp(others.indexOf(this.#read.series) + across, 0, others.length - 1)];
    const index = clamp(this.#read.index + along, 0, next.points.length - 1);
    this.#readPlace(this.#places.find((place) => place.series === next && place.index === index));
  }

  #readPlace(place) {
    if (place === this.#read) return;
    this.#read = place;
    this.#ring.setAttribute("visibility", place ? "visible" : "hidden");
    if (place) {
      this.#ring.setAttribute("cx", place.x);
      this.#ring.setAttribute("cy", place.y);
    }
    this.#onRead(place?.series ?? null, place?.index ?? null);
  }

  #pick() {
    if (this.#read) this.#onPick(this.#read.series, this.#read.index);
  }
}

function scaleX(series, left, right) {
  const rates = series.flatMap((each) => each.points.map((point) => point.mbps));
  const [low, high] = rates.length ? [Math.min(...rates) / 1.1, Math.max(...rates) * 1.1] : [1, 32];
  const at = (mbps) => left + ((right - left) * Math.log(mbps / low)) / Math.log(high / low);
  return { at, ticks: TICKS_MBPS.filter((tick) => tick >= low && tick <= high) };
}

function scaleY(series, grades, bottom, top) {
  const values = series.flatMap((each) => each.points.map((point) => point.quality));
  let [low, high] = values.length ? [Math.min(...values), Math.max(...values)] : [0, 1];
  if (grades.length) [low, high] = [Math.min(low, 65), Math.max(high, 93)];
  const margin = 0.05 * (high - low || 1);
  [low, high] = [low - margin, grades.length ? Math.min(high + margin, 101) : high + margin];
  const step = niceStep((high - low) / 5);
  const ticks = [];
  for (let count = Math.ceil(low / step); count * step <= high; count += 1) ticks.push(count * step);
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  return { at: (value) => bottom - ((bottom - top) * (value - low)) / (high - low), ticks, digits };
}

/** The smallest of 1, 2, 5 times a power of ten that is not below `wanted`. */
function niceStep(wanted) {
  const power = 10 ** Math.floor(Math.log10(wanted));
  return power * [1, 2, 5, 10].find((factor) => factor * power >= wanted * (1 - 1e-9));
}

function axes(x, y, right, title) {
  const group = svg("g", { class: "axes" });
  for (const tick of y.ticks) {
    group.append(
      svg("path", { class: "grid", d: `M${LEFT},${y.at(tick)} H${right}` }),
      svg("text", { x: LEFT - 8, y: y.at(tick) + 4, "text-anchor": "end" }, tick.toFixed(y.digits)),
    );
  }
  for (const tick of x.ticks) {
    group.append(
      svg("path", { class: "tick", d: `M${x.at(tick)},${HEIGHT - BOTTOM} v4` }),
      svg("text", { x: x.at(tick), y: HEIGHT - BOTTOM + 17, "text-anchor": "middle" }, String(tick)),
    );
  }
  group.append(
    svg("path", { class: "base", d: `M${LEFT},${HEIGHT - BOTTOM} H${right}` }),
    svg("text", { class: "title", x: right, y: HEIGHT - 5, "text-anchor": "end" }, "true bitrate, Mbit/s"),
    svg("text", { class: "title", x: 0, y: 11 }, title),
  );
  return group;
}

function gradeLines(y, grades, right) {
  const group = svg("g", { class: "grades" });
  for (const [quality, word] of grades) {
    group.append(
      svg("path", { d: `M${LEFT},${y.at(quality)} H${right}` }),
      svg("text", { x: LEFT + 4, y: y.at(quality) - 4 }, `${word} ${quality}`),
    );
  }
  return group;
}

function line(look, places) {
  const path = places.map((place, index) => `${index ? "L" : "M"}${place.x.toFixed(1)},${place.y.toFixed(1)}`).join(" ");
  const group = svg("g", { class: `series ${look.colour}` });
  group.append(svg("path", { class: "line", d: path || "M0,0", "stroke-dasharray": look.dash }));
  for (const place of places) group.append(svg("path", { class: "marker", d: look.marker, transform: `translate(${place.x},${place.y})` }));
  return group;
}

function names(series, x, y, right) {
  const ends = series
    .filter((each) => each.points.length)
    .map((each) => ({ each, x: x.at(each.points.at(-1).mbps), y: y.at(each.points.at(-1).quality) }))
    .sort((one, other) => one.y - other.y);
  const group = svg("g", { class: "names" });
  apart(ends.map((end) => end.y)).forEach((place, index) => {
    const { each, ...end } = ends[index];
    group.append(
      svg("path", { class: `leader ${each.look.colour}`, d: `M${end.x + 6},${end.y} L${right + 4},${place}` }),
      svg("text", { class: each.look.colour, x: right + 8, y: place + 4 }, each.name),
    );
  });
  return group;
}

/** Rising places moved as little as keeps neighbours a line of text apart and all of them inside the panel. */
function apart(wanted) {
  const places = [...wanted];
  for (let index = 1; index < places.length; index += 1) places[index] = Math.max(places[index], places[index - 1] + NAME_STEP);
  let limit = HEIGHT - BOTTOM - 4;
  for (let index = places.length - 1; index >= 0; index -= 1) {
    places[index] = Math.min(places[index], limit);
    limit = places[index] - NAME_STEP;
  }
  return places;
}

function clamp(value, low, high) {
  return Math.min(Math.max(value, low), high);
}
