// Which two pictures the viewer shows: reference, native or an upscaler's, of one frame of one clip at one bitrate.

import { picture } from "./api.js";
import { element } from "./dom.js";
import { METRICS, mbps } from "./curves.js";
import { NATIVE, label } from "./looks.js";
import { Viewer } from "./viewer.js";

const REFERENCE = "reference";
const PREFERRED = { left: ["bicubic", NATIVE], right: ["gamesr"] };

export class Frames {
  #fields;
  #captions;
  #status;
  #viewer;
  #sweep = null;
  #points = [];
  #height = 0;
  #waiting = new AbortController();
  #seen = false; // nothing is encoded for those who never look
  #shown = "";

  constructor(root) {
    const field = (name) => root.querySelector(`#frame-${name}`);
    this.#fields = { clip: field("clip"), bitrate: field("bitrate"), number: field("number"), left: field("left"), right: field("right") };
    this.#captions = { left: root.querySelector("#caption-left"), right: root.querySelector("#caption-right") };
    this.#status = field("status");
    this.#viewer = new Viewer(root.querySelector(".viewer"));
    for (const each of Object.values(this.#fields)) each.addEventListener("change", () => this.#load());
    new IntersectionObserver(([entry]) => {
      this.#seen = entry.isIntersecting;
      this.#load();
    }).observe(root);
  }

  /** Offers what was swept from `height`; what is chosen stays chosen where it is still there. */
  show(sweep, points, height) {
    [this.#sweep, this.#points, this.#height] = [sweep, points, height];
    const upscalers = [...new Set(points.filter((point) => point.upscaler === NATIVE || point.low_height === height).map((point) => point.upscaler))];
    const pictures = [REFERENCE, ...upscalers];
    offer(this.#fields.clip, sweep.clips.map((clip) => [clip.clip, clip.clip]));
    offer(this.#fields.bitrate, sweep.bitrates_kbps.map((kbps) => [kbps, `${mbps(kbps)} Mbit/s`]), middle(sweep.bitrates_kbps));
    for (const side of ["left", "right"]) {
      const first = PREFERRED[side].find((name) => pictures.includes(name));
      offer(this.#fields[side], pictures.map((name) => [name, label(name)]), first ?? pictures.at(-1));
    }
    this.#load();
  }

  /** The pictures of one measured point beside what is on the left. */
  pick(point) {
    this.#fields.clip.value = point.clip;
    this.#fields.bitrate.value = String(point.requested_kbps);
    this.#fields.right.value = point.upscaler;
    this.#load();
  }

  async #load() {
    if (!this.#seen || !this.#sweep) return;
    this.#waiting.abort();
    this.#waiting = new AbortController();
    const { signal } = this.#waiting;
    const clip = this.#sweep.clips.find((each) => each.clip === this.#fields.clip.value);
    if (!clip) return this.#say("This sweep has no clip yet.");
    if (clip.source === null) return this.#say("The service has measurements of this clip, but not its file: no pictures.");
    if (clip.frames !== null) this.#fields.number.max = clip.frames - 1;
    if (!this.#fields.number.reportValidity()) return;
    const sides = ["left", "right"].map((side) => this.#fields[side].value);
    const paths = sides.map((name) => this.#path(clip, name));
    if (paths.join() === this.#shown) return this.#say("");
    this.#say("Encoding and upscaling up to this frame …");
    try {
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

  #path(clip, name) {
    const path = `frames/${encodeURIComponent(clip.source)}/${this.#fields.number.value}?picture=${encodeURIComponent(name)}`;
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

  #say(sentence) {
    this.#status.textContent = sentence;
  }
}

function offer(select, options, first) {
  const chosen = select.value;
  select.replaceChildren(...options.map(([value, text]) => element("option", { value: String(value) }, text)));
  const values = options.map(([value]) => String(value));
  if (values.includes(chosen)) select.value = chosen;
  else if (first !== undefined) select.value = String(first);
}

function middle(values) {
  return [...values].sort((one, other) => one - other)[Math.floor((values.length - 1) / 2)];
}
