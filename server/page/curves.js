// Rate-distortion curves, a panel a clip, and the point that is read, in words below it.

import { Chart } from "./chart.js";
import { element } from "./dom.js";
import { NATIVE, label } from "./looks.js";

/** What can be on the y axis: the field of a point's quality, its name, its digits. */
export const METRICS = {
  vmaf: { name: "VMAF", digits: 1, graded: true },
  vmaf_neg: { name: "VMAF-NEG", digits: 1, graded: true },
  psnr_y_db: { name: "PSNR-Y", unit: "dB", digits: 2 },
  ssim_y: { name: "SSIM-Y", digits: 4 },
};
const HINT = "Point at a curve or use the arrow keys to read it; click or Enter shows its pictures.";
const GRADES = [
  [70, "fair"],
  [80, "good"],
  [90, "excellent"],
];

export class Curves {
  #holder;
  #onPick;
  #panels = new Map(); // by clip, kept so that a chart in use stays in focus when points arrive

  /** `onPick(point)` is told which point was chosen. */
  constructor(holder, onPick) {
    this.#holder = holder;
    this.#onPick = onPick;
  }

  /** `choice`: {clips, upscalers, height, metric}; `points` are the service's; `looks` by upscaler. */
  show(points, choice, looks) {
    const metric = METRICS[choice.metric];
    const panels = choice.clips.map((clip) => {
      const panel = this.#panels.get(clip) ?? this.#panel(clip);
      const shown = seriesOf(points, clip, choice, looks);
      panel.title.textContent = titleOf(clip, points, choice.height);
      panel.remarks.replaceChildren(...shown.remarks.map((reason) => element("li", {}, reason)));
      panel.chart.show({
        series: shown.series,
        grades: metric.graded ? GRADES : [],
        axis: metric.unit ? `${metric.name}, ${metric.unit}` : metric.name,
        summary: `${metric.name} of ${clip} over bitrate: ${shown.series.map((each) => each.name).join(", ")}.`,
      });
      this.#panels.set(clip, panel);
      return panel.root;
    });
    const same = panels.length === this.#holder.children.length && panels.every((root, index) => root === this.#holder.children[index]);
    if (!same) this.#holder.replaceChildren(...panels);
  }

  clear() {
    this.#panels.clear();
    this.#holder.replaceChildren();
  }

  #panel(clip) {
    const [title, remarks] = [element("h3"), element("ul", { className: "notes" })];
    const [plot, reading] = [element("div", { className: "plot" }), element("p", { className: "reading", role: "status" }, HINT)];
    const chart = new Chart(plot, {
      onRead: (series, index) => (reading.textContent = series ? inWords(series.points[index].of) : HINT),
      onPick: (series, index) => this.#onPick(series.points[index].of),
    });
    return { root: element("div", { className: "panel" }, title, plot, reading, remarks), title, remarks, chart };
  }
}

function seriesOf(points, clip, choice, looks) {
  const quality = (point) => point.quality[choice.metric];
  const remarks = new Map(); // what is to be said of points, and the curves of which it is true
  const say = (sentence, upscaler) => remarks.set(sentence, [...(remarks.get(sentence) ?? []), label(upscaler)]);
  const series = choice.upscalers.map((upscaler) => {
    const own = points
      .filter((point) => point.clip === clip && point.upscaler === upscaler && (upscaler === NATIVE || point.low_height === choice.height))
      .sort((one, other) => one.bitrate_kbps - other.bitrate_kbps);
    for (const point of own) {
      const reason = point.quality.undefined[choice.metric];
      const asked = `Asked for ${mbps(point.requested_kbps)} Mbit/s`;
      if (reason) say(`${asked}, not drawn: ${reason}`, upscaler);
      for (const flag of point.flags) say(`${asked}: ${flag}`, upscaler);
    }
    const drawn = own.filter((point) => quality(point) !== null);
    return {
      name: label(upscaler),
      look: looks.get(upscaler),
      points: drawn.map((point) => ({ mbps: point.bitrate_kbps / 1000, quality: quality(point), of: point })),
    };
  });
  return { series, remarks: [...remarks].map(([sentence, upscalers]) => `${sentence} (${upscalers.join(", ")}).`) };
}

function titleOf(clip, points, height) {
  const native = points.find((point) => point.clip === clip)?.height;
  return native ? `${clip}, ${height}p to ${native}p` : clip;
}

/** Everything that was measured at one point. */
function inWords(point) {
  const figures = Object.entries(METRICS).map(([field, { name, unit, digits }]) => {
    const value = point.quality[field];
    return value === null ? `${name} undefined` : `${name} ${value.toFixed(digits)}${unit ? ` ${unit}` : ""}`;
  });
  return `${label(point.upscaler)} ${point.low_height}p at ${mbps(point.bitrate_kbps)} Mbit/s: ${figures.join(", ")}`;
}

export function mbps(kbps) {
  return (kbps / 1000).toFixed(2).replace(/\.?0+$/, "");
}
