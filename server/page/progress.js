// How far sweeps are: a line each, moved by the service's events, with a button that cancels.

import { follow, isOver, post } from "./api.js";
import { element } from "./dom.js";

export class SweepList {
  #holder;
  #onShow;
  #onChange;
  #onProblem;
  #stop = () => {};

  /** `onShow(id)` when one is asked for; `onChange(id, progress)` when one got further; `onProblem(error)` when cancelling was refused. */
  constructor(holder, { onShow, onChange, onProblem }) {
    this.#holder = holder;
    [this.#onShow, this.#onChange, this.#onProblem] = [onShow, onChange, onProblem];
  }

  show(sweeps) {
    this.#stop();
    if (!sweeps.length) {
      this.#holder.replaceChildren(element("li", { className: "empty" }, "No sweep yet: start one below, or run gamesr-sweep on this store."));
      return;
    }
    const active = sweeps.filter((sweep) => sweep.origin === "service" && !isOver(sweep.progress));
    const next = active.find((sweep) => sweep.progress.state === "running") ?? active.at(-1);
    this.#holder.replaceChildren(...sweeps.map((sweep) => this.#line(sweep, sweep === next)));
  }

  /** Only the sweep that runs, or will run next, is `followed`: a browser has few connections to one place. */
  #line(sweep, followed) {
    const name = nameOf(sweep);
    const bar = element("progress", { "aria-label": `Progress of ${name}` });
    const words = element("span", { className: "words" });
    const showing = button("Show", `Show ${name}`, () => this.#onShow(sweep.id));
    const cancelling = button("Cancel", `Cancel ${name}`, () => this.#cancel(sweep.id, cancelling, changed));
    const update = (progress) => {
      const [done, total] = counts(progress);
      bar.max = total || 1;
      bar.value = done;
      bar.hidden = isOver(progress) || progress.state === "partial";
      words.textContent = inWords(progress);
      cancelling.hidden = sweep.origin === "command" || isOver(progress);
    };
    update(sweep.progress);
    const changed = (progress) => {
      update(progress);
      this.#onChange(sweep.id, progress);
    };
    if (followed) this.#stop = follow(sweep.id, changed);
    const failures = sweep.failures.map((failure) => element("li", {}, failureInWords(failure)));
    return element(
      "li",
      { "data-sweep": sweep.id },
      element("span", { className: "name" }, name),
      bar,
      words,
      element("span", { className: "buttons" }, showing, cancelling),
      element("ul", { className: "notes" }, ...failures),
    );
  }

  async #cancel(id, pressed, changed) {
    pressed.disabled = true;
    try {
      changed((await post(`sweeps/${encodeURIComponent(id)}/cancel`)).progress);
    } catch (error) {
      this.#onProblem(error);
    } finally {
      pressed.disabled = false;
    }
  }
}

/** What people call a sweep: its clips and when it was begun. */
export function nameOf(sweep) {
  const began = new Date(1000 * sweep.created_at).toLocaleString(undefined, { dateStyle: "medium", timeStyle: "short" });
  const clips = sweep.clips.map((clip) => clip.clip).join(", ");
  return clips ? `${clips}, ${began}` : `sweep of ${began}`;
}

function counts(progress) {
  const done = progress.points_done + progress.points_failed + progress.latencies_done + progress.latencies_failed;
  return [done, (progress.points_total ?? 0) + (progress.latencies_total ?? 0)];
}

function inWords(progress) {
  const words = [progress.state];
  if (progress.points_total !== null) words.push(`${progress.points_done} of ${progress.points_total} points`);
  if (progress.latencies_total) words.push(`${progress.latencies_done} of ${progress.latencies_total} latencies`);
  if (progress.points_failed + progress.latencies_failed) words.push(`${progress.points_failed + progress.latencies_failed} failed`);
  if (progress.remaining_s !== null && !isOver(progress)) words.push(`${duration(progress.remaining_s)} left`);
  if (progress.waiting) words.push(`waiting: ${progress.waiting}`);
  if (progress.reason) words.push(progress.reason);
  return words.join(", ");
}

function failureInWords({ clip, low_height, upscaler, requested_kbps, reason }) {
  const what = requested_kbps === null ? "latency" : `${requested_kbps} kbps`;
  return `${clip}, ${upscaler} ${low_height}p, ${what}: ${reason}`;
}

function duration(seconds) {
  if (seconds < 90) return `${Math.ceil(seconds)} s`;
  const minutes = Math.round(seconds / 60);
  return minutes < 90 ? `${minutes} min` : `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

function button(text, name, onClick) {
  const made = element("button", { type: "button", "aria-label": name }, text);
  made.addEventListener("click", onClick);
  return made;
}
