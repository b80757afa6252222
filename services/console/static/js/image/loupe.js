// The loupe: the surroundings of the pointer or of the measurement crosshair, enlarged four times.

import { h } from "../base/dom.js";

const DISTANCE_PX = 28;

export class Loupe {
  /** `view`: an `ImageView`; `wanted()` returns whether the loupe is switched on. */
  constructor(view, wanted) {
    this.view = view;
    this.wanted = wanted;
    this.element = h("canvas", { class: "loupe hidden", "aria-hidden": "true" });
  }

  /** Show the surroundings of [row, column], beside its place on the canvas; hide the loupe without a point. */
  show(point) {
    const shown = point !== null && this.view.image !== null && this.wanted();
    this.element.classList.toggle("hidden", !shown);
    if (!shown) return;
    const { offsetLeft, offsetTop, clientWidth, clientHeight } = this.view.canvas;
    const size = this.element.clientWidth;
    const [x, y] = this.view.canvasAt(point);
    const left = x + DISTANCE_PX + size < clientWidth ? x + DISTANCE_PX : x - DISTANCE_PX - size;
    const top = Math.max(0, Math.min(clientHeight - size, y - DISTANCE_PX - size));
    this.element.style.left = `${offsetLeft + Math.max(0, left)}px`;
    this.element.style.top = `${offsetTop + top}px`;
    this.view.drawLoupe(this.element, point);
  }
}
