// How each upscaler is drawn: colour, marker and dash together, so that none of them has to be told by colour alone.

import { svg } from "./dom.js";

export const NATIVE = "none";
const COLOURS = 6; // in style.css, after Okabe and Ito; the first upscaler has the first of them
const DASHES = ["", "7 3", "2 3"];
const MARKERS = {
  circle: "M-4,0 a4,4 0 1,0 8,0 a4,4 0 1,0 -8,0 Z",
  square: "M-3.6,-3.6 H3.6 V3.6 H-3.6 Z",
  triangle: "M0,-4.8 L4.6,3.4 H-4.6 Z",
  diamond: "M0,-5 L4.6,0 L0,5 L-4.6,0 Z",
  wedge: "M0,4.8 L4.6,-3.4 H-4.6 Z",
  plus: "M-1.7,-4.6 H1.7 V-1.7 H4.6 V1.7 H1.7 V4.6 H-1.7 V1.7 H-4.6 V-1.7 H-1.7 Z",
  cross: "M-4.4,-2.2 L-2.2,-4.4 L0,-2.2 L2.2,-4.4 L4.4,-2.2 L2.2,0 L4.4,2.2 L2.2,4.4 L0,2.2 L-2.2,4.4 L-4.4,2.2 L-2.2,0 Z",
};
const ORDER = ["square", "triangle", "diamond", "wedge", "plus", "cross"];

/** What people call an upscaler: none is native resolution. */
export function label(upscaler) {
  return upscaler === NATIVE ? "native" : upscaler;
}

/** The look of every upscaler by its place among all that are known, so that picking some never recolours the others. */
export function looks(upscalers) {
  const found = new Map([[NATIVE, { colour: "native", dash: "", marker: MARKERS.circle }]]);
  upscalers
    .filter((name) => name !== NATIVE)
    .forEach((name, index) => {
      const place = index % COLOURS;
      found.set(name, {
        colour: `colour-${place}`,
        dash: DASHES[Math.floor(index / COLOURS) % DASHES.length],
        marker: MARKERS[ORDER[place]],
      });
    });
  return found;
}

/** A short line with its marker, for a legend. */
export function swatch(look) {
  return svg(
    "svg",
    { class: `swatch ${look.colour}`, width: 30, height: 12, viewBox: "-15 -6 30 12", "aria-hidden": "true" },
    svg("path", { class: "line", d: "M-15,0 H15", "stroke-dasharray": look.dash }),
    svg("path", { class: "marker", d: look.marker }),
  );
}
