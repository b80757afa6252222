// Toolbar of the image.

import { fill, h } from "../base/dom.js";
import { layerName } from "../base/format.js";
import { MAPS } from "./image_data.js";
import { ORIENTATIONS } from "./image_projection.js";
import { t } from "../texts.js";

/** A button; a `key` is in its name. `props`: as of `h`, and `text`. */
function button(tool, label, key, handler, { text = label, ...props } = /** @type {Record<string, any>} */ ({})) {
  const name = key ? `${label} (${key})` : label;
  return h("button", { type: "button", title: name, "aria-label": name, data: { tool }, on: { click: handler }, ...props }, text);
}

/** A button that is pressed or not. */
const toggle = (tool, key, pressed, handler, props = {}) => button(tool, t(`tools.${tool}_title`), key, handler, { text: t(`tools.${tool}`), "aria-pressed": String(pressed), ...props });

/** A menu; a name in `disabled` cannot be selected. */
function menu(tool, key, names, value, changed, disabled = []) {
  const label = key ? `${t(`tools.${tool}`)} (${key})` : t(`tools.${tool}`);
  const element = h("select", { "aria-label": label, title: label, data: { tool }, on: { change: (event) => changed(event.target.value) } },
    names.map((name) => h("option", { value: name, text: t(`tools.${tool}_${name}`), disabled: disabled.includes(name) })));
  element.value = value;
  return element;
}

const group = (name, children) => h("span", { class: "set", role: "group", data: { set: name }, "aria-label": t(`tools.${name}`) }, children);

/** Draw the toolbar after a change: new buttons would close an open menu and lose a click. The focus is kept. */
export function drawTools(view) {
  const locked = view.measurementLock();
  const compared = view.shown !== null && view.comparedImage() !== null;
  const { display, more } = view;
  const { projection, smooth } = view.views[0];
  const orientation = projection?.orientation ?? "nadir";
  const ground = projection?.convertible ?? false;
  const disabled = ORIENTATIONS.filter((name) => name !== "nadir" && !projection?.orientable(name));
  const element = view.tools;
  const drawn = JSON.stringify([view.layers, view.shown?.texture, view.layer, view.autoGain, compared, view.detail.versions.length, locked, view.measurement.active, orientation, disabled, more, display, smooth, ground, view.loupeOn]);
  if (element.dataset.drawn === drawn) return;
  element.dataset.drawn = drawn;
  const focused = document.activeElement?.dataset?.tool;
  fill(element,
    view.layers.length > 1 ? group("layer", view.layers.map(({ name, reason }) => button(`layer-${name}`, layerName(view.shown, name), "", () => view.showLayer(name), {
      "aria-pressed": String(name === view.layer), title: reason || t("tools.received_pixels") }))) : null,
    group("gain", [
      button("darker", t("shortcuts.image.darker"), ",", () => view.changeGain(-1), { text: "−" }),
      toggle("auto", "a", view.autoGain, () => view.changeGain(0)),
      button("brighter", t("shortcuts.image.brighter"), ".", () => view.changeGain(1), { text: "+" })]),
    group("zoom", [
      button("out", t("shortcuts.image.zoom_out"), "-", () => view.zoom(1 / 1.5), { text: "−" }),
      button("fit", t("tools.fit_title"), "0", () => view.fit(), { text: t("tools.fit") }),
      button("in", t("shortcuts.image.zoom_in"), "+", () => view.zoom(1.5), { text: "+" })]),
    button("measure", locked ? t("tools.measure_locked_title", { reason: locked }) : t("tools.measure_title"), "m", () => view.startMeasurement(), {
      text: t("tools.measure"), "aria-pressed": String(view.measurement.active), "aria-disabled": locked ? "true" : null, class: locked ? "locked" : "" }),
    menu("view", "v", ORIENTATIONS, orientation, (name) => view.setOrientation(name), disabled),
    toggle("compare", "s", compared, () => view.toggleCompare(), { disabled: view.detail.versions.length < 2 }),
    button("more", t("tools.more"), "", () => view.toggleMore(), { text: "⋯", "aria-expanded": String(more) }),
    more ? [
      toggle("grid", "", display.grid, () => view.toggleGrid()),
      toggle("ground", "", display.ground && ground, () => view.toggleGround(), ground ? {} : { "aria-disabled": "true", class: "locked" }),
      toggle("smooth", "", smooth, () => view.toggleSmooth()),
      toggle("loupe", "", view.loupeOn, () => view.toggleLoupe()),
      menu("map", "", Object.keys(MAPS), display.map, (name) => view.setMap(name))] : null);
  if (focused) element.querySelector(`[data-tool="${CSS.escape(focused)}"]`)?.focus();
}
