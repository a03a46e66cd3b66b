// The form that starts a sweep, on clips that the service has or on one that is uploaded.

import { get, post, upload } from "./api.js";
import { choices, chosen } from "./choices.js";
import { NATIVE, label } from "./looks.js";

const USUAL = [NATIVE, "bicubic", "lanczos", "fsr1", "gamesr"];
const PARTS = { 2: "half", 3: "a third" };

export class StartForm {
  #form;
  #field;
  #onStarted;
  #onProblem;
  #clips = [];

  /** `onStarted(sweep)` when the service has taken it, `onProblem(error)` when it has not. */
  constructor(form, { onStarted, onProblem }) {
    this.#form = form;
    this.#field = (name) => form.querySelector(`#start-${name}`);
    [this.#onStarted, this.#onProblem] = [onStarted, onProblem];
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.#start();
    });
  }

  /** Asks the service what there is to choose from. */
  async fill() {
    const [{ clips }, { models }] = await Promise.all([get("clips"), get("models")]);
    const names = [NATIVE, ...new Set(models.map((model) => model.name))];
    const upscalers = this.#field("upscalers");
    if (!upscalers.children.length) {
      upscalers.replaceChildren(...choices("checkbox", "start-upscaler", names.map((name) => [name, label(name)]), USUAL));
      const parts = Object.entries(PARTS).map(([scale, part]) => [scale, `${part} of the height`]);
      this.#field("heights").replaceChildren(...choices("checkbox", "start-height", parts, Object.keys(PARTS)));
    }
    this.#showClips(clips, chosen(this.#field("clips")));
  }

  #showClips(clips, ticked) {
    this.#clips = clips;
    const names = clips.map((clip) => [clip.name, `${clip.title} (${clip.width}×${clip.height}, ${clip.fps} fps, ${clip.duration_s.toFixed(1)} s)`]);
    this.#field("clips").replaceChildren(...(names.length ? choices("checkbox", "start-clip", names, ticked) : ["The service has no clip yet: upload one."]));
  }

  async #start() {
    const submit = this.#form.querySelector("[type=submit]");
    submit.disabled = true;
    try {
      const uploaded = await this.#uploaded();
      if (uploaded) this.#showClips([...this.#clips.filter((clip) => clip.name !== uploaded.name), uploaded], [...chosen(this.#field("clips")), uploaded.name]);
      this.#onStarted(await post("sweeps", this.#request()));
    } catch (error) {
      this.#onProblem(error);
    } finally {
      submit.disabled = false;
    }
  }

  async #uploaded() {
    const [file, bar] = [this.#field("file"), this.#field("upload")];
    if (!file.files.length) return null;
    bar.hidden = false;
    try {
      const clip = await upload(file.files[0], (share) => (bar.value = share));
      file.value = "";
      return clip;
    } finally {
      bar.hidden = true;
    }
  }

  #request() {
    const clips = chosen(this.#field("clips"));
    if (!clips.length) throw new Error("Choose a clip, or a file to upload.");
    const bitrates = this.#field("bitrates").value.split(",").map((text) => Math.round(1000 * Number(text)));
    if (!bitrates.every((kbps) => kbps >= 1)) throw new Error("Bitrates are numbers of megabits a second with commas between them, such as 2, 4, 8.");
    const parts = chosen(this.#field("heights")).map(Number);
    if (!parts.length) throw new Error("Choose from which heights is to be upscaled.");
    const frames = this.#field("frames").value;
    return {
      clips,
      bitrates_kbps: bitrates,
      upscalers: chosen(this.#field("upscalers")),
      scales: parts.length === Object.keys(PARTS).length ? null : parts, // both: a clip that has only one of them will do
      frames: frames ? Number(frames) : null,
    };
  }
}
