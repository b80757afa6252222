// A request for a region: a box drawn on the image, and a dialog with the cost and the expected detail.

import { api } from "../base/api.js";
import { h, showDialog, showError, toast } from "../base/dom.js";
import { DASH, duration, quantity } from "../base/format.js";
import { about } from "./request_buttons.js";
import { state } from "../base/state.js";
import { t } from "../texts.js";

const STEPS = 32; // edges of the box along each side
const LEAST_BYTES = 24;
const MOST_BYTES = 512;
// [bytes a pixel, smallest detail in pixels]: as in sonarpost/review/resolution.py.
const DETAIL = [[0.0025, 7.8], [0.00375, 5.1], [0.0075, 3.9], [0.01125, 3.6], [0.015, 3.1], [0.0225, 2.8], [0.03, 2.6], [0.05, 2.4], [0.2, 2.4]];

/** Smallest detail in pixels of an image with this many bytes a pixel. */
export function detailPx(density) {
  if (density <= DETAIL[0][0]) return DETAIL[0][1];
  for (let i = 1; i < DETAIL.length; i += 1) {
    const [[low, from], [high, to]] = [DETAIL[i - 1], DETAIL[i]];
    if (density <= high) return from + (to - from) * Math.log(density / low) / Math.log(high / low);
  }
  return DETAIL.at(-1)[1];
}

/** Edges in 1/32 of the sides of a box between two points [row, column] of the image. */
export function boxBetween(from, to, height, width) {
  const edges = (a, b, side) => {
    const start = Math.min(STEPS - 1, Math.max(0, Math.floor(Math.min(a, b) / side * STEPS)));
    return [start, Math.min(STEPS, Math.max(start + 1, Math.ceil(Math.max(a, b) / side * STEPS)))];
  };
  const [top, bottom] = edges(from[0], to[0], height);
  const [left, right] = edges(from[1], to[1], width);
  return [top, left, bottom, right];
}

/** Let the user draw a box on the image; then show the cost, and send the request. Escape leaves. */
export function startRegion(view, detail) {
  if (!detail || !view.views[0].image) return;
  document.querySelector(".region-layer")?.remove();
  if (!state.session.may.request) { toast(t("region_request.not_allowed"), { bad: true }); return; }
  const canvas = view.canvases[0];
  const box = h("div", { class: "region-box" });
  const layer = h("div", { class: "region-layer", tabindex: 0, role: "application", "aria-label": t("region_request.hint") }, h("p", { text: t("region_request.hint") }), box);
  const { left, top, width, height } = canvas.getBoundingClientRect();
  Object.assign(layer.style, { left: `${left}px`, top: `${top}px`, width: `${width}px`, height: `${height}px` });
  let from = null;
  const point = (event) => [event.clientX - left, event.clientY - top];
  layer.addEventListener("pointerdown", (event) => { from = point(event); layer.setPointerCapture(event.pointerId); });
  layer.addEventListener("pointermove", (event) => {
    if (!from) return;
    const to = point(event);
    Object.assign(box.style, { left: `${Math.min(from[0], to[0])}px`, top: `${Math.min(from[1], to[1])}px`, width: `${Math.abs(to[0] - from[0])}px`, height: `${Math.abs(to[1] - from[1])}px` });
  });
  layer.addEventListener("pointerup", (event) => {
    if (!from) return;
    const image = view.views[0];
    const edges = boxBetween(image.pixelAt(...from), image.pixelAt(...point(event)), image.image.height, image.image.width);
    layer.remove();
    confirmRegion(detail, edges, image);
  });
  layer.addEventListener("keydown", (event) => { if (event.key === "Escape") { event.stopPropagation(); layer.remove(); } });
  document.body.append(layer);
  layer.focus();
}

async function confirmRegion({ contact, costs, versions }, box, view) {
  const [top, left, bottom, right] = box;
  const pixels = (bottom - top) / STEPS * view.image.height * (right - left) / STEPS * view.image.width;
  const { pixel_along_m: along_m, pixel_across_m: across_m } = versions.at(-1);
  const wider_m = along_m && across_m ? Math.max(along_m, across_m) : null;
  const cost = costs.find((one) => one.kind === "region");
  const slider = h("input", { type: "range", min: LEAST_BYTES, max: MOST_BYTES, step: 8, value: cost.bytes, "aria-label": t("region_request.bytes") });
  const estimate = h("output", {});
  // Air time of other lengths than that of the cost.
  const airtime = () => (cost.airtime_s === null ? null : cost.downlink_s + (cost.airtime_s - cost.downlink_s) * slider.valueAsNumber / cost.bytes);
  const draw = () => {
    const detail = detailPx(slider.valueAsNumber / pixels);
    estimate.textContent = t("region_request.estimate", {
      bytes: slider.value, seconds: duration(airtime()), detail: wider_m ? quantity(detail * wider_m, "m", 2) : quantity(detail, "px"),
      arrives: cost.median_s === null ? DASH : about(cost.median_s + airtime() - cost.airtime_s),
    });
  };
  slider.addEventListener("input", draw);
  draw();
  const action = await showDialog(t("region_request.title", { name: contact.name }), [h("p", { text: t("region_request.explanation") }), slider, h("p", {}, estimate)],
    [{ label: t("request_buttons.send"), value: "send", primary: true }, { label: t("dialog.cancel"), value: null }]);
  if (action !== "send") return;
  await api.request(contact.id, { kind: "region", box, stream_bytes: slider.valueAsNumber, airtime_s: airtime() })
    .then(() => toast(t("region_request.sent", { name: contact.name })), showError);
}
