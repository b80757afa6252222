// Toolbar, version buttons, measurement hint and mouse operation of the image.

import { api } from "./api.js";
import { fill, h } from "./dom.js";
import { received, time } from "./format.js";
import { KINDS } from "./measurement.js";
import { MAPS } from "./image_data.js";

export const COMPARE = { off: "one image", versions: "first and newest", layers: "raw and enhanced" };

function button(label, key, handler, { text = label, ...props } = {}) {
  return h("button", { type: "button", title: `${label} (${key})`, "aria-label": `${label} (${key})`, on: { click: handler }, ...props }, text, " ", h("kbd", { text: key }));
}

/** Draw the toolbar; the focused button keeps the focus. */
export function drawTools(view) {
  const focused = document.activeElement?.dataset?.tool;
  const locked = view.measurementLock();
  const compared = view.compare !== "off" && view.shown !== null && view.comparedImage() !== null;
  // New buttons would close an open menu and lose a click. They are created only after a change.
  const drawn = JSON.stringify([view.shown?.layers, view.layer, view.display, view.autoGain, view.compare, compared, locked, view.measurement.active]);
  if (view.tools.dataset.drawn === drawn) return;
  view.tools.dataset.drawn = drawn;
  const layers = (view.shown?.layers ?? []).map((one) => h("button", {
    type: "button", "aria-pressed": String(one.name === view.layer), title: one.reason || "received pixels", data: { tool: `layer-${one.name}` },
    on: { click: () => view.showLayer(one.name) }, text: one.synthesised ? `${one.name} ✱` : one.name,
  }));
  const maps = h("select", { "aria-label": "Colour map (c)", data: { tool: "map" }, on: { change: (event) => view.setMap(event.target.value) } },
    Object.keys(MAPS).map((name) => h("option", { value: name, text: name })));
  maps.value = view.display.map;
  fill(view.tools,
    h("span", { class: "set", role: "group", "aria-label": "Layer (e)" }, layers, h("kbd", { text: "e" })),
    h("span", { class: "set" }, maps, h("kbd", { text: "c" })),
    h("span", { class: "set", role: "group", "aria-label": "Gain" },
      button("darker", ",", () => view.changeGain(-1), { text: "☾", data: { tool: "darker" } }),
      button("automatic gain", "a", () => view.changeGain(0), { text: "auto", "aria-pressed": String(view.autoGain), data: { tool: "auto" } }),
      button("brighter", ".", () => view.changeGain(1), { text: "☀", data: { tool: "brighter" } })),
    h("span", { class: "set", role: "group", "aria-label": "Zoom" },
      button("zoom out", "-", () => view.zoom(1 / 1.5), { text: "", data: { tool: "out" } }),
      button("whole image", "0", () => view.fit(), { text: "fit", data: { tool: "fit" } }),
      button("zoom in", "+", () => view.zoom(1.5), { text: "", data: { tool: "in" } })),
    button("hatch missing areas", "h", () => view.toggleHatch(), { text: "hatch", "aria-pressed": String(view.display.hatch), data: { tool: "hatch" } }),
    button(`side by side: ${COMPARE[view.compare]}`, "s", () => view.nextCompare(), { text: compared ? COMPARE[view.compare] : "compare", "aria-pressed": String(compared), data: { tool: "compare" } }),
    button(locked ? `measurement is locked: ${locked}` : "measure", "m", () => view.startMeasurement(), {
      text: locked ? "measure locked" : "measure", "aria-pressed": String(view.measurement.active), "aria-disabled": locked ? "true" : null, class: locked ? "locked" : "", data: { tool: "measure" },
    }));
  if (focused) view.tools.querySelector(`[data-tool="${CSS.escape(focused)}"]`)?.focus();
}

/** Draw a button for each of the last eight versions. */
export function drawVersions(view) {
  const { versions } = view.detail;
  const newest = versions.at(-1)?.version;
  fill(view.versions, versions.length ? h("kbd", { text: "[" }) : null, versions.slice(-8).map((one) => h("button", {
    type: "button", "aria-pressed": String(one.version === view.version), on: { click: () => view.showVersion(one.version) },
    "aria-label": `Version ${one.version}, ${received(one)} received, ${time(one.received_utc_s)}`,
  }, h("img", { src: api.thumbnailUrl(view.detail.contact.id, one.version), alt: "" }), h("span", { class: "number", text: `v${one.version} ${received(one)}` }))),
  versions.length ? h("kbd", { text: "]" }) : null,
  newest && view.version !== newest ? h("span", { class: "stale", text: `Version ${newest} is newer than the displayed one.` }) : null);
  view.versions.querySelector('[aria-pressed="true"]')?.scrollIntoView({ block: "nearest", inline: "nearest" });
}

/** Draw the instruction for the next step of a measurement. */
export function drawHint(view) {
  const existing = view.stage.querySelector(".hint");
  existing?.remove();
  if (!view.measurement.active) return;
  const text = view.measurement.result ? "Enter keeps it, Esc discards it" : view.measurement.from ? "second end: click, or arrows and Enter" : "first end: click, or arrows (Shift: 5 px) and Enter";
  view.stage.append(h("p", { class: "hint", role: "status" }, h("b", { text: view.measurement.kind }), ` — ${text}; `, h("kbd", { text: "m" }), ` ${KINDS.at(-1) === view.measurement.kind ? "ends" : "next kind"}`));
}

/** Zoom with the wheel, move by dragging, set a measurement point with a click. */
export function startMouse(view) {
  const canvas = view.canvases[0];
  canvas.tabIndex = 0;
  let dragStart = null;
  for (const [index, one] of view.canvases.entries()) {
    one.addEventListener("wheel", (event) => {
      event.preventDefault();
      view.views[index].zoom(event.deltaY < 0 ? 1.25 : 0.8, event.offsetX, event.offsetY);
      view.redrawAll();
    }, { passive: false });
    one.addEventListener("pointerdown", (event) => {
      if (index === 0 && view.measurement.active) {
        view.measurement.moveTo(view.views[0].pixelAt(event.offsetX, event.offsetY));
        view.measurement.setPoint();
      } else dragStart = [event.clientX, event.clientY];
    });
    one.addEventListener("pointermove", (event) => {
      if (index === 0 && view.measurement.active && !view.measurement.result) view.measurement.moveTo(view.views[0].pixelAt(event.offsetX, event.offsetY));
      if (!dragStart || !view.views[index].image) return;
      view.views[index].drag(event.clientX - dragStart[0], event.clientY - dragStart[1]);
      dragStart = [event.clientX, event.clientY];
      view.redrawAll();
    });
    one.addEventListener("dblclick", () => view.fit());
  }
  addEventListener("pointerup", () => { dragStart = null; });
}
