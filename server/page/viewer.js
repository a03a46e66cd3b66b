// Two pictures of one frame, one over the other up to a wipe, at the same place and zoom.

const ZOOMS = [0, 1, 2, 4, 8]; // device pixels a picture's pixel takes; 0: as large as the stage is
const WIPE_STEP = 2; // percent
const PAN_STEP = 48; // of the page's pixels
const PIXELATED_FROM = 2;

/** Wires the .viewer of index.html: its wipe, its zoom buttons, its keys. Hidden until there is something to see. */
export class Viewer {
  #root;
  #stage;
  #pictures;
  #wipe;
  #handle;
  #zoomButtons;
  #zoom = 0;
  #centre = [0.5, 0.5]; // of the stage, in parts of the picture
  #size = null; // of the picture, in its own pixels

  constructor(root) {
    this.#root = root;
    this.#stage = root.querySelector(".stage");
    this.#pictures = [...root.querySelectorAll(".stage img")];
    this.#handle = root.querySelector(".handle");
    this.#wipe = root.querySelector(".wipe input");
    this.#zoomButtons = [...root.querySelectorAll("[data-zoom]")];
    this.#wipe.addEventListener("input", () => this.#place());
    for (const button of this.#zoomButtons) button.addEventListener("click", () => this.#setZoom(Number(button.dataset.zoom)));
    this.#stage.addEventListener("keydown", (event) => this.#key(event));
    this.#stage.addEventListener("pointerdown", (event) => this.#drag(event));
    new ResizeObserver(() => this.#place()).observe(this.#stage);
  }

  /**
   * Shows `left` and `right`, {url, name} each, when both are there. Place, zoom and wipe stay.
   * Rejects with an error when a picture does not come; the former pictures then stay.
   */
  async show(left, right) {
    this.#stage.setAttribute("aria-busy", "true");
    try {
      const loaded = await Promise.all([left, right].map((side) => decoded(side.url)));
      loaded.forEach((picture, index) => {
        this.#pictures[index].src = picture.src;
        this.#pictures[index].alt = [left, right][index].name;
      });
      this.#size = [loaded[0].naturalWidth, loaded[0].naturalHeight];
      this.#stage.style.aspectRatio = `${this.#size[0]} / ${this.#size[1]}`;
      this.#root.hidden = false;
      this.#place();
    } finally {
      this.#stage.removeAttribute("aria-busy");
    }
  }

  #key(event) {
    const keys = {
      ArrowLeft: () => this.#pan(-PAN_STEP, 0),
      ArrowRight: () => this.#pan(PAN_STEP, 0),
      ArrowUp: () => this.#pan(0, -PAN_STEP),
      ArrowDown: () => this.#pan(0, PAN_STEP),
      "+": () => this.#setZoom(ZOOMS[Math.min(ZOOMS.indexOf(this.#zoom) + 1, ZOOMS.length - 1)]),
      "-": () => this.#setZoom(ZOOMS[Math.max(ZOOMS.indexOf(this.#zoom) - 1, 0)]),
      0: () => this.#setZoom(0),
      "[": () => this.#moveWipe(Number(this.#wipe.value) - WIPE_STEP),
      "]": () => this.#moveWipe(Number(this.#wipe.value) + WIPE_STEP),
    };
    if (event.ctrlKey || event.metaKey || event.altKey || !(event.key in keys)) return;
    event.preventDefault();
    keys[event.key]();
  }

  /** The handle drags the wipe, everything else the picture. */
  #drag(event) {
    event.preventDefault();
    this.#stage.focus();
    this.#stage.setPointerCapture(event.pointerId);
    const wiping = event.target === this.#handle || this.#zoom === 0;
    let [x, y] = [event.clientX, event.clientY];
    const move = (moved) => {
      if (wiping) {
        const box = this.#stage.getBoundingClientRect();
        this.#moveWipe((100 * (moved.clientX - box.left)) / box.width);
      } else {
        this.#pan(x - moved.clientX, y - moved.clientY);
        [x, y] = [moved.clientX, moved.clientY];
      }
    };
    if (wiping) move(event);
    this.#stage.addEventListener("pointermove", move);
    const end = () => this.#stage.removeEventListener("pointermove", move);
    this.#stage.addEventListener("pointerup", end, { once: true });
    this.#stage.addEventListener("pointercancel", end, { once: true });
  }

  #moveWipe(percent) {
    this.#wipe.value = percent;
    this.#place();
  }

  #setZoom(zoom) {
    this.#zoom = zoom;
    this.#place();
  }

  #pan(x, y) {
    if (!this.#size) return;
    const scale = this.#scale();
    this.#centre = this.#centre.map((part, axis) => part + [x, y][axis] / (this.#size[axis] * scale));
    this.#place();
  }

  /** The page's pixels that one of the picture's takes. */
  #scale() {
    return this.#zoom ? this.#zoom / devicePixelRatio : this.#stage.clientWidth / this.#size[0];
  }

  #place() {
    if (!this.#size || !this.#stage.clientWidth) return;
    const scale = this.#scale();
    const stage = [this.#stage.clientWidth, this.#stage.clientHeight];
    this.#centre = this.#centre.map((part, axis) => {
      const half = Math.min(0.5, stage[axis] / (2 * this.#size[axis] * scale)); // no further than the picture's edge
      return Math.min(Math.max(part, half), 1 - half);
    });
    const offset = this.#centre.map((part, axis) => stage[axis] / 2 - part * this.#size[axis] * scale);
    const wipe = (Number(this.#wipe.value) / 100) * stage[0];
    for (const picture of this.#pictures) {
      picture.style.width = `${this.#size[0]}px`;
      picture.style.height = `${this.#size[1]}px`;
      picture.style.transform = `translate(${offset[0]}px, ${offset[1]}px) scale(${scale})`;
      picture.style.imageRendering = this.#zoom >= PIXELATED_FROM ? "pixelated" : "auto";
    }
    this.#pictures[1].style.clipPath = `inset(0 0 0 ${Math.max(0, (wipe - offset[0]) / scale)}px)`;
    this.#handle.style.left = `${wipe}px`;
    for (const button of this.#zoomButtons) button.setAttribute("aria-pressed", String(Number(button.dataset.zoom) === this.#zoom));
  }
}

async function decoded(url) {
  const picture = new Image();
  picture.src = url;
  await picture.decode();
  return picture;
}
