// Which two pictures the viewer shows: reference, native or an upscaler's, of one frame of one clip at one bitrate.

import { get, picture } from "./api.js";
import { element } from "./dom.js";
import { METRICS, mbps } from "./curves.js";
import { NATIVE, label } from "./looks.js";
import { Viewer } from "./viewer.js";

const REFERENCE = "reference";
const FIRST = 10; // a network that remembers has something to remember by then
const OURS = "gamesr";
const BASELINES = ["bicubic", NATIVE];

export class Frames {
  #fields;
  #captions;
  #status;
  #viewer;
  #sweep = null;
  #points = [];
  #height = 0;
  #waiting = new AbortController();
  #chosen = new Set(); // fields that somebody set
  #seen = false; // nothing is encoded for those who never look
  #clips = null; // the service's answer
  #shown = "";

  constructor(root) {
    const field = (name) => root.querySelector(`#frame-${name}`);
    this.#fields = { clip: field("clip"), bitrate: field("bitrate"), number: field("number"), left: field("left"), right: field("right") };
    this.#captions = { left: root.querySelector("#caption-left"), right: root.querySelector("#caption-right") };
    this.#status = field("status");
    this.#viewer = new Viewer(root.querySelector(".viewer"));
    for (const each of Object.values(this.#fields)) {
      each.addEventListener("change", () => {
        this.#chosen.add(each);
        this.#load();
      });
    }
    new IntersectionObserver(([entry]) => {
      this.#seen = entry.isIntersecting;
      this.#load();
    }).observe(root);
  }

  /** Offers what was swept from `height`; what somebody chose stays chosen where it is still there. */
  show(sweep, points, height) {
    [this.#sweep, this.#points, this.#height] = [sweep, points, height];
    const upscalers = [...new Set(points.filter((point) => point.upscaler === NATIVE || point.low_height === height).map((point) => point.upscaler))];
    const pictures = [REFERENCE, ...upscalers];
    this.#offer(this.#fields.clip, sweep.clips.map((clip) => [clip.clip, clip.clip]), sweep.clips[0]?.clip);
    this.#offer(this.#fields.bitrate, sweep.bitrates_kbps.map((kbps) => [kbps, `${mbps(kbps)} Mbit/s`]), middle(sweep.bitrates_kbps));
    const names = pictures.map((name) => [name, label(name)]);
    const right = pictures.includes(OURS) ? OURS : pictures.at(-1);
    this.#offer(this.#fields.right, names, right);
    this.#offer(this.#fields.left, names, BASELINES.find((name) => name !== right && pictures.includes(name)));
    this.#load();
  }

  /** The pictures of one measured point beside what is on the left. */
  pick(point) {
    this.#fields.clip.value = point.clip;
    this.#fields.bitrate.value = String(point.requested_kbps);
    this.#fields.right.value = point.upscaler;
    for (const field of ["clip", "bitrate", "right"]) this.#chosen.add(this.#fields[field]);
    this.#load();
  }

  async #load() {
    if (!this.#seen || !this.#sweep) return;
    this.#waiting.abort();
    this.#waiting = new AbortController();
    const { signal } = this.#waiting;
    const clip = this.#sweep.clips.find((each) => each.clip === this.#fields.clip.value);
    if (!clip) return this.#say("This sweep has no clip yet.");
    this.#limitNumber(clip);
    if (!this.#fields.number.reportValidity()) return;
    const sides = ["left", "right"].map((side) => this.#fields[side].value);
    try {
      const source = clip.source ?? (await this.#sourceOf(clip.sha256));
      if (signal.aborted) return;
      if (source === undefined) return this.#say("The service has measurements of this clip, but not its file: no pictures.");
      const paths = sides.map((name) => this.#path(source, clip, name));
      if (paths.join() === this.#shown) return this.#say("");
      this.#say("Encoding and upscaling up to this frame …");
      const urls = await Promise.all(paths.map((path) => picture(path, signal)));
      if (signal.aborted) return;
      const [left, right] = sides.map((name, index) => ({ url: urls[index], name: this.#caption(clip, name) }));
      await this.#viewer.show(left, right);
      this.#captions.left.textContent = left.name;
      this.#captions.right.textContent = right.name;
      this.#shown = paths.join();
      this.#say("");
    } catch (error) {
      if (error.name !== "AbortError") this.#say(error.message);
    }
  }

  /** A service that has just been started knows no clip by its content before somebody asks it for its clips. */
  async #sourceOf(sha256) {
    this.#clips ??= get("clips");
    this.#clips.catch(() => (this.#clips = null));
    return (await this.#clips).clips.find((clip) => clip.sha256 === sha256)?.name;
  }

  /** To the frames that were measured. */
  #limitNumber(clip) {
    const { number } = this.#fields;
    const frames = Math.max(1, ...this.#points.filter((point) => point.clip === clip.clip).map((point) => point.quality.frames));
    number.max = frames - 1;
    if (!this.#chosen.has(number)) number.value = Math.min(FIRST, frames - 1);
  }

  #path(source, clip, name) {
    const frame = `${encodeURIComponent(source)}/${this.#fields.number.value}`;
    const path = `frames/${frame}?picture=${encodeURIComponent(name)}&fps=${clip.fps}`;
    if (name === REFERENCE) return path;
    const height = name === NATIVE ? clip.height : this.#height;
    return `${path}&low_height=${height}&bitrate_kbps=${this.#fields.bitrate.value}`;
  }

  /** The picture's name, and what was measured over the whole clip at this bitrate. */
  #caption(clip, name) {
    if (name === REFERENCE) return REFERENCE;
    const point = this.#points.find(
      (each) =>
        each.clip === clip.clip &&
        each.upscaler === name &&
        each.requested_kbps === Number(this.#fields.bitrate.value) &&
        (name === NATIVE || each.low_height === this.#height),
    );
    if (!point) return label(name);
    const vmaf = point.quality.vmaf === null ? "" : `, ${METRICS.vmaf.name} ${point.quality.vmaf.toFixed(METRICS.vmaf.digits)}`;
    return `${label(name)} ${point.low_height}p, ${mbps(point.bitrate_kbps)} Mbit/s${vmaf}`;
  }

  #offer(select, options, first) {
    const values = options.map(([value]) => String(value));
    const kept = this.#chosen.has(select) && values.includes(select.value) ? select.value : first;
    select.replaceChildren(...options.map(([value, text]) => element("option", { value: String(value) }, text)));
    if (kept !== undefined) select.value = String(kept);
  }

  #say(sentence) {
    this.#status.textContent = sentence;
  }
}

function middle(values) {
  return [...values].sort((one, other) => one - other)[Math.floor((values.length - 1) / 2)];
}
