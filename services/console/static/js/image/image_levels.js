// Black point, white point and gamma of the image, as sliders.

import { h } from "../base/dom.js";
import { t } from "../texts.js";

const SLIDERS = [["low", 0, 95, 1], ["high", 5, 150, 1], ["gamma", 0.3, 3, 0.05]];

export class ImageLevels {
  /** `changed(name, value)` is called when a slider is moved. */
  constructor(changed) {
    this.inputs = {};
    this.outputs = {};
    this.element = h("div", { class: "levels", role: "group", "aria-label": t("levels.group") }, SLIDERS.map(([name, min, max, step]) => {
      this.inputs[name] = h("input", { type: "range", min, max, step, id: `level-${name}`, on: { input: (event) => changed(name, Number(event.target.value)) } });
      this.outputs[name] = h("output", { for: `level-${name}`, class: "number" });
      return h("label", {}, h("span", { text: t(`levels.${name}`) }), this.inputs[name], this.outputs[name]);
    }));
  }

  update(display) {
    for (const [name] of SLIDERS) {
      this.inputs[name].value = display[name];
      this.outputs[name].textContent = name === "gamma" ? display.gamma.toFixed(2) : `${Math.round(display[name])}\u202f%`;
    }
  }
}
