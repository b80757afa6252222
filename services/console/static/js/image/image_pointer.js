// Mouse, pen and touch on the image: zoom, move, pinch, measure by dragging.

import { continuesOut } from "../contact/related_images.js";

const GRAB_PX = 14;
const DRAG_PX = 5;

/** Zoom with the wheel or two fingers, move by dragging, measure a line with one drag or two clicks. */
export function startPointer(view) {
  const canvas = view.canvases[0];
  canvas.tabIndex = 0;
  const pointers = new Map(); // pointer → [x, y] on the canvas
  let pinch = null; // distance and centre of two fingers
  let line = null; // start of a line that is drawn, in CSS pixels
  const at = (event) => /** @type {Point} */ ([event.offsetX, event.offsetY]);
  const measures = (index) => index === 0 && view.measurement.active && view.views[0].image !== null;

  const twoFingers = () => {
    const [[x0, y0], [x1, y1]] = [...pointers.values()];
    return { distance: Math.hypot(x1 - x0, y1 - y0), x: (x0 + x1) / 2, y: (y0 + y1) / 2 };
  };

  for (const [index, one] of view.canvases.entries()) {
    const image = view.views[index];
    one.addEventListener("wheel", (event) => {
      event.preventDefault();
      const factor = event.deltaY < 0 ? 1.25 : 0.8;
      if (continuesOut(view, factor)) {
        view.showLayer("expand");
        return;
      }
      image.zoom(factor, ...at(event));
      view.redrawAll();
    }, { passive: false });

    one.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      pointers.set(event.pointerId, at(event));
      if (pointers.size === 2) {
        pinch = twoFingers();
        if (line) { view.measurement.clear(); line = null; }
      } else if (measures(index)) {
        // The browser sends the movements of this pointer to the canvas, also outside of it.
        one.setPointerCapture(event.pointerId);
        line = at(event);
        view.measurement.press(grabbed(view, line), image.pixelAt(...line));
      }
    });

    one.addEventListener("pointermove", (event) => {
      const point = at(event);
      const before = pointers.get(event.pointerId);
      if (before) pointers.set(event.pointerId, point);
      if (!image.image) return;
      if (pinch && pointers.size === 2) {
        const now = twoFingers();
        image.zoom(now.distance / Math.max(1, pinch.distance), now.x, now.y);
        image.drag(now.x - pinch.x, now.y - pinch.y);
        pinch = now;
        view.redrawAll();
      } else if (measures(index)) {
        if (!view.measurement.result || line) view.measurement.moveTo(image.pixelAt(...point));
      } else if (before) {
        image.drag(point[0] - before[0], point[1] - before[1]);
        view.redrawAll();
      }
      if (index === 0) view.showLoupe(image.pixelAt(...point));
    });

    one.addEventListener("pointerleave", () => { if (index === 0) view.showLoupe(null); });
    one.addEventListener("dblclick", () => { if (!measures(index)) view.fit(); });
  }

  const released = (event) => {
    const drawn = line;
    pointers.delete(event.pointerId);
    if (pointers.size < 2) pinch = null;
    if (!drawn) return;
    line = null;
    // Without a movement this was a click: the first end, or the second one.
    const moved = Math.hypot(event.offsetX - drawn[0], event.offsetY - drawn[1]) > DRAG_PX;
    view.measurement.release(event.type === "pointerup", moved);
  };
  addEventListener("pointerup", released);
  addEventListener("pointercancel", released);
}

/** The end of the displayed result at a point: "from", "to" or null. */
function grabbed(view, [x, y]) {
  const { result } = view.measurement;
  if (!result) return null;
  return ["to", "from"].find((end) => {
    const [endX, endY] = view.views[0].canvasAt(result[end]);
    return Math.hypot(endX - x, endY - y) <= GRAB_PX;
  }) ?? null;
}
