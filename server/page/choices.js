// Groups of checkboxes and of radio buttons.

import { element } from "./dom.js";

/** A labelled input for each [value, text, decoration?]; those in `ticked` are on. */
export function choices(type, name, options, ticked) {
  return options.map(([value, text, decoration]) =>
    element(
      "label",
      { className: "choice" },
      element("input", { type, name, value: String(value), checked: ticked.includes(value) }),
      ...(decoration ? [decoration] : []),
      element("span", {}, text),
    ),
  );
}

/** The values that are on, in their order. */
export function chosen(group) {
  return [...group.querySelectorAll("input:checked")].map((input) => input.value);
}
