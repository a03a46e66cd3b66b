// The page: what is picked, what the service has of it, and the sections that show it.

import { get, isOver, keepKey } from "./api.js";
import { choices, chosen } from "./choices.js";
import { Curves, METRICS } from "./curves.js";
import { element } from "./dom.js";
import { Frames } from "./frames.js";
import { Latency } from "./latency.js";
import { label, looks, swatch } from "./looks.js";
import { SweepList, nameOf } from "./progress.js";
import { savingTables } from "./savings.js";
import { StartForm } from "./start.js";

const GRADES = { 70: "fair", 80: "good", 90: "excellent" };
const REFRESH_MS = 2000; // no more often are the figures of a running sweep read again
const UNAUTHORIZED = [401, 403];

const find = (selector) => document.querySelector(selector);
const groups = { clips: find("#pick-clips"), height: find("#pick-height"), metric: find("#pick-metric"), upscalers: find("#pick-upscalers") };
const frames = new Frames(find("#frames"));
const curves = new Curves(find("#curves .panels"), (point) => {
  frames.pick(point);
  find("#frames").scrollIntoView();
});
const latency = new Latency(find("#latency .panels"));
const list = new SweepList(find("#sweeps .sweeps"), { onShow: (id) => guarded(() => showSweep(id)), onChange: sweepMoved, onProblem: refused });
const start = new StartForm(find("#start-form"), { onStarted: started, onProblem: refused });

let sweep = null; // the one that is shown
let figures = { points: [], latencies: [], posted: [], bdRates: { bd_rates: [] } };
let refresh = 0; // the timer of the next reading
let wantedSweep = 0; // answers come in any order: only the one to the newest question counts
let wantedSavings = 0;

async function showSweeps(wanted) {
  const { sweeps } = await get("sweeps");
  list.show(sweeps);
  const select = find("#sweep");
  select.replaceChildren(...sweeps.map((each) => element("option", { value: each.id }, nameOf(each))));
  const first = sweeps.find((each) => each.id === wanted) ?? sweeps.find((each) => each.progress.points_done) ?? sweeps[0];
  select.disabled = !first;
  if (first) await showSweep(first.id);
  else showNothing();
}

async function showSweep(id) {
  const path = `sweeps/${encodeURIComponent(id)}`;
  const question = (wantedSweep += 1);
  const [found, { points }, { latencies }, { latencies: posted }, bdRates] = await Promise.all(
    [path, `${path}/points`, `${path}/latencies`, "client-latencies", `${path}/bd-rates`].map(get),
  );
  if (question !== wantedSweep) return;
  const another = sweep?.id !== id;
  [sweep, figures] = [found, { points, latencies, posted, bdRates }];
  find("#sweep").value = id;
  fillPickers(another);
  await draw();
  frames.show(sweep, points, choice().height);
}

function showNothing() {
  for (const holder of ["#curves .panels", "#savings .tables"]) {
    find(holder).replaceChildren(element("p", { className: "empty" }, "No sweep is in the store yet: start one below."));
  }
  find("#start").open = true;
}

/** What there is to pick; what was picked stays so where it still is. */
function fillPickers(afresh) {
  const order = lookOf();
  const heights = sweep.low_heights.filter((height) => figures.points.some((point) => point.upscaler !== "none" && point.low_height === height));
  const clips = sweep.clips.map((clip) => [clip.clip, clip.clip]);
  fill("clips", "checkbox", clips, afresh);
  fill("height", "radio", heights.map((height) => [height, `${height}p`]), afresh);
  fill("metric", "radio", Object.entries(METRICS).map(([field, { name }]) => [field, name]), false);
  fill("upscalers", "checkbox", sweep.upscalers.map((name) => [name, label(name), swatch(order.get(name))]), afresh);
}

function fill(name, type, options, afresh) {
  const known = [...groups[name].querySelectorAll("input")].map((input) => input.value);
  const before = chosen(groups[name]);
  const values = options.map(([value]) => value);
  if (!afresh && known.join() === values.join()) return; // an input in use keeps the focus
  const kept = afresh ? [] : values.filter((value) => before.includes(String(value)) || !known.includes(String(value)));
  const ticked = type === "radio" ? values.slice(0, 1) : values;
  groups[name].replaceChildren(...choices(type, `pick-${name}`, options, kept.length && type === "checkbox" ? kept : ticked));
}

function choice() {
  return {
    clips: chosen(groups.clips),
    upscalers: chosen(groups.upscalers),
    height: Number(chosen(groups.height)[0] ?? 0),
    metric: chosen(groups.metric)[0],
  };
}

function lookOf() {
  return looks(sweep.upscalers);
}

async function draw() {
  const picked = choice();
  const empty = emptiness(picked);
  latency.show(figures.latencies, figures.posted, picked);
  if (empty) {
    curves.clear();
    for (const holder of ["#curves .panels", "#savings .tables"]) find(holder).replaceChildren(element("p", { className: "empty" }, empty));
    return;
  }
  if (find("#curves .empty")) curves.clear();
  curves.show(figures.points, picked, lookOf());
  await drawSavings(picked);
}

function emptiness(picked) {
  if (!figures.points.length) return isOver(sweep.progress) ? "This sweep has no point." : "This sweep has no point yet.";
  if (!picked.clips.length) return "No clip is picked.";
  if (!picked.upscalers.length) return "No upscaler is picked.";
  return null;
}

async function drawSavings(picked) {
  const target = find("#target");
  if (!target.checkValidity()) return;
  const metric = METRICS[picked.metric].graded ? picked.metric : "vmaf"; // of the others nobody has said what is good
  find("#target-metric").textContent = METRICS[metric].name;
  for (const button of find("#grades").children) button.setAttribute("aria-pressed", String(button.value === target.value));
  const question = (wantedSavings += 1);
  const savings = await get(`sweeps/${encodeURIComponent(sweep.id)}/savings?metric=${metric}&target=${target.value}`);
  if (question === wantedSavings) find("#savings .tables").replaceChildren(...savingTables(savings, figures.bdRates, picked, lookOf()));
}

function sweepMoved(id, progress) {
  if (isOver(progress)) {
    clearTimeout(refresh);
    refresh = 0;
    guarded(() => showSweeps(sweep?.id ?? id));
  } else if (sweep?.id === id && !refresh) {
    refresh = setTimeout(() => {
      refresh = 0;
      guarded(() => showSweep(id));
    }, REFRESH_MS);
  }
}

function started(made) {
  say("#sweep-status", "The sweep is queued.");
  find("#start").open = false;
  guarded(() => showSweeps(made.id));
}

function refused(error) {
  say("#sweep-status", error.message);
  if (!UNAUTHORIZED.includes(error.status)) return;
  find("#key-form").hidden = false;
  find("#key").focus();
}

/** Runs what asks the service, and says in one sentence when it cannot. */
async function guarded(work) {
  try {
    await work();
    find("#problem").hidden = true;
  } catch (error) {
    say("#problem", error.message);
    find("#problem").hidden = false;
  }
}

function say(place, sentence) {
  find(place).textContent = sentence;
}

for (const [grade, word] of Object.entries(GRADES)) {
  const button = element("button", { type: "button", value: grade }, `${grade} ${word}`);
  button.addEventListener("click", () => {
    find("#target").value = grade;
    guarded(draw);
  });
  find("#grades").append(button);
}
find("#target").addEventListener("input", () => guarded(() => drawSavings(choice())));
find("#sweep").addEventListener("change", (event) => guarded(() => showSweep(event.target.value)));
find("#pickers").addEventListener("change", (event) =>
  guarded(async () => {
    await draw();
    if (event.target.name === "pick-height") frames.show(sweep, figures.points, choice().height);
  }),
);
find("#pickers").addEventListener("submit", (event) => event.preventDefault());
find("#start").addEventListener("toggle", () => find("#start").open && guarded(() => start.fill()));
find("#key-form").addEventListener("submit", (event) => {
  event.preventDefault();
  keepKey(find("#key").value);
  find("#key-form").hidden = true;
  say("#sweep-status", "The key is kept until this tab is closed: try again.");
});
guarded(() => showSweeps());
