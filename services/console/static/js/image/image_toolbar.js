// Toolbar of the image.

import { fill, h } from "../base/dom.js";
import { layerName } from "../base/format.js";
import { MAPS } from "./image_data.js";
import { ORIENTATIONS } from "./image_projection.js";
import { emit } from "../base/state.js";
import { t } from "../texts.js";

export const COMPARE_MODES = ["off", "versions", "layers"];

function button(label, key, handler, { text = label, ...props } = {}) {
  return h("button", { type: "button", title: `${label} (${key})`, "aria-label": `${label} (${key})`, on: { click: handler }, ...props }, text, " ", h("kbd", { text: key }));
}

/** A button that is pressed or not. */
function toggle(tool, key, pressed, handler, props = {}) {
  return button(t(`tools.${tool}_title`), key, handler, { text: t(`tools.${tool}`), "aria-pressed": String(pressed), data: { tool }, ...props });
}

/** A menu; a name in `disabled` cannot be selected. */
function menu(tool, key, names, value, changed, disabled = []) {
  const element = h("select", { "aria-label": `${t(`tools.${tool}`)} (${key})`, data: { tool }, on: { change: (event) => changed(event.target.value) } },
    names.map((name) => h("option", { value: name, text: t(`tools.${tool}_${name}`), disabled: disabled.includes(name) })));
  element.value = value;
  return h("span", { class: "set" }, element, h("kbd", { text: key }));
}

/** Fill a toolbar after a change of `drawn`: new buttons would close an open menu and lose a click. The focus is kept. */
function refill(element, drawn, children) {
  const key = JSON.stringify(drawn);
  if (element.dataset.drawn === key) return;
  element.dataset.drawn = key;
  const focused = document.activeElement?.dataset?.tool;
  fill(element, children());
  if (focused) element.querySelector(`[data-tool="${CSS.escape(focused)}"]`)?.focus();
}

/** Draw the toolbar and the options of the display. */
export function drawTools(view) {
  const locked = view.measurementLock();
  const compared = view.compare !== "off" && view.shown !== null && view.comparedImage() !== null;
  const open = !view.displayPanel.classList.contains("hidden");
  const { display } = view;
  refill(view.tools, [view.layers, view.shown?.texture, view.layer, display.map, open, view.autoGain, view.compare, compared, locked, view.measurement.active], () => [
    h("span", { class: "set", role: "group", "aria-label": `${t("tools.layer")} (e)` }, view.layers.map((one) => h("button", {
      type: "button", "aria-pressed": String(one.name === view.layer), title: one.reason || t("tools.received_pixels"), data: { tool: `layer-${one.name}` },
      on: { click: () => view.showLayer(one.name) }, text: `${layerName(view.shown, one.name)}${one.synthesised ? " ✱" : ""}`,
    })), h("kbd", { text: "e" })),
    menu("map", "c", Object.keys(MAPS), display.map, (name) => view.setMap(name)),
    h("span", { class: "set", role: "group", "aria-label": t("tools.gain") },
      button(t("tools.darker"), ",", () => view.changeGain(-1), { text: "−", data: { tool: "darker" } }),
      button(t("tools.auto_title"), "a", () => view.changeGain(0), { text: t("tools.auto"), "aria-pressed": String(view.autoGain), data: { tool: "auto" } }),
      button(t("tools.brighter"), ".", () => view.changeGain(1), { text: "+", data: { tool: "brighter" } })),
    h("span", { class: "set", role: "group", "aria-label": t("tools.zoom") },
      button(t("tools.out"), "-", () => view.zoom(1 / 1.5), { text: "", data: { tool: "out" } }),
      button(t("tools.fit_title"), "0", () => view.fit(), { text: t("tools.fit"), data: { tool: "fit" } }),
      button(t("tools.in"), "+", () => view.zoom(1.5), { text: "", data: { tool: "in" } })),
    toggle("display", "I", open, () => view.toggleDisplayPanel(), { "aria-expanded": String(open), "aria-pressed": null }),
    button(t("tools.compare_title", { mode: t(`tools.compare_${view.compare}`) }), "s", () => view.nextCompare(), {
      text: compared ? t(`tools.compare_${view.compare}`) : t("tools.compare"), "aria-pressed": String(compared), data: { tool: "compare" } }),
    button(locked ? t("tools.measure_locked_title", { reason: locked }) : t("tools.measure"), "m", () => view.startMeasurement(), {
      text: locked ? t("tools.measure_locked") : t("tools.measure"), "aria-pressed": String(view.measurement.active), "aria-disabled": locked ? "true" : null, class: locked ? "locked" : "", data: { tool: "measure" },
    }),
  ]);
  drawOptions(view);
  view.levels.update(display);
}

function drawOptions(view) {
  const { display } = view;
  const { projection, smooth } = view.views[0];
  const orientation = projection?.orientation ?? "nadir";
  const ground = projection?.convertible ?? false;
  const disabled = ORIENTATIONS.filter((name) => name !== "nadir" && !projection?.orientable(name));
  refill(view.options, [display.hatch, display.grid, display.ground, orientation, smooth, ground, disabled, view.loupeOn], () => [
    toggle("hatch", "h", display.hatch, () => view.toggleHatch()),
    toggle("grid", "#", display.grid, () => view.toggleGrid()),
    toggle("smooth", "d", smooth, () => view.toggleSmooth()),
    toggle("ground", "b", display.ground && ground, () => view.toggleGround(), ground ? {} : { "aria-disabled": "true", class: "locked" }),
    menu("view", "v", ORIENTATIONS, orientation, (name) => view.setOrientation(name), disabled),
    h("button", { type: "button", title: `${t("region_request.key")} (7)`, data: { tool: "region" }, on: { click: () => emit("region") } }, t("region_request.button"), " ", h("kbd", { text: "7" })),
    toggle("loupe", "'", view.loupeOn, () => view.toggleLoupe()),
  ]);
}
