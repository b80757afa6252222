// Around the picture: tools, versions, the hint while measuring, and what the mouse does.

import { api } from "./api.js";
import { fill, h } from "./dom.js";
import { received, time } from "./format.js";
import { KINDS } from "./measure.js";
import { MAPS } from "./picture_data.js";

export const COMPARE = { off: "one picture", versions: "first and newest", layers: "raw and enhanced" };

function button(label, key, handler, props = {}) {
  return h("button", { type: "button", title: `${label} (${key})`, "aria-label": `${label} (${key})`, on: { click: handler }, ...props }, props.words ?? label, " ", h("kbd", { text: key }));
}

/** The toolbar; what had the focus keeps it. */
export function drawTools(view) {
  const focused = document.activeElement?.dataset?.tool;
  const locked = view.measureLock();
  const compared = view.compare !== "off" && view.shown !== null && view.second() !== null;
  // An open menu or a click under way would be lost with the buttons: they are made anew only when they differ.
  const drawn = JSON.stringify([view.shown?.layers, view.layer, view.look, view.auto, view.compare, compared, locked, view.measuring.active]);
  if (view.tools.dataset.drawn === drawn) return;
  view.tools.dataset.drawn = drawn;
  const layers = (view.shown?.layers ?? []).map((one) => h("button", {
    type: "button", "aria-pressed": String(one.name === view.layer), title: one.reason || "as it was measured", data: { tool: `layer-${one.name}` },
    on: { click: () => view.showLayer(one.name) }, text: one.synthesised ? `${one.name} ✱` : one.name,
  }));
  const maps = h("select", { "aria-label": "Colour map (c)", data: { tool: "map" }, on: { change: (event) => view.setMap(event.target.value) } },
    Object.keys(MAPS).map((name) => h("option", { value: name, text: name })));
  maps.value = view.look.map;
  fill(view.tools,
    h("span", { class: "set", role: "group", "aria-label": "Layer (e)" }, layers, h("kbd", { text: "e" })),
    h("span", { class: "set" }, maps, h("kbd", { text: "c" })),
    h("span", { class: "set", role: "group", "aria-label": "Gain" },
      button("darker", ",", () => view.gain(-1), { words: "☾", data: { tool: "darker" } }),
      button("automatic gain", "a", () => view.gain(0), { words: "auto", "aria-pressed": String(view.auto), data: { tool: "auto" } }),
      button("brighter", ".", () => view.gain(1), { words: "☀", data: { tool: "brighter" } })),
    h("span", { class: "set", role: "group", "aria-label": "Zoom" },
      button("zoom out", "-", () => view.zoom(1 / 1.5), { words: "", data: { tool: "out" } }),
      button("whole picture", "0", () => view.fit(), { words: "fit", data: { tool: "fit" } }),
      button("zoom in", "+", () => view.zoom(1.5), { words: "", data: { tool: "in" } })),
    button("hatch over what is missing", "h", () => view.toggleHatch(), { words: "hatch", "aria-pressed": String(view.look.hatch), data: { tool: "hatch" } }),
    button(`side by side: ${COMPARE[view.compare]}`, "s", () => view.nextCompare(), { words: compared ? COMPARE[view.compare] : "compare", "aria-pressed": String(compared), data: { tool: "compare" } }),
    button(locked ? `measuring is locked: ${locked}` : "measure", "m", () => view.measure(), {
      words: locked ? "measuring locked" : "measure", "aria-pressed": String(view.measuring.active), "aria-disabled": locked ? "true" : null, class: locked ? "locked" : "", data: { tool: "measure" },
    }));
  if (focused) view.tools.querySelector(`[data-tool="${CSS.escape(focused)}"]`)?.focus();
}

/** One button a version, the last eight. */
export function drawVersions(view) {
  const { versions } = view.detail;
  const newest = versions.at(-1)?.version;
  fill(view.versions, versions.length ? h("kbd", { text: "[" }) : null, versions.slice(-8).map((one) => h("button", {
    type: "button", "aria-pressed": String(one.version === view.version), on: { click: () => view.showVersion(one.version) },
    "aria-label": `Version ${one.version}, ${received(one)} received, ${time(one.received_utc_s)}`,
  }, h("img", { src: api.thumbnailUrl(view.detail.contact.id, one.version), alt: "" }), h("span", { class: "number", text: `v${one.version} ${received(one)}` }))),
  versions.length ? h("kbd", { text: "]" }) : null,
  newest && view.version !== newest ? h("span", { class: "stale", text: `Version ${newest} is newer than the one shown.` }) : null);
  view.versions.querySelector('[aria-pressed="true"]')?.scrollIntoView({ block: "nearest", inline: "nearest" });
}

/** What to do next while measuring. */
export function drawHint(view) {
  const existing = view.stage.querySelector(".hint");
  existing?.remove();
  if (!view.measuring.active) return;
  const words = view.measuring.result ? "Enter keeps it, Esc discards it" : view.measuring.from ? "second end: click, or arrows and Enter" : "first end: click, or arrows (Shift: 5 px) and Enter";
  view.stage.append(h("p", { class: "hint", role: "status" }, h("b", { text: view.measuring.kind }), ` — ${words}; `, h("kbd", { text: "m" }), ` ${KINDS.at(-1) === view.measuring.kind ? "ends" : "next kind"}`));
}

/** Wheel zooms, dragging moves, a click sets a point while measuring. */
export function startMouse(view) {
  const canvas = view.canvases[0];
  canvas.tabIndex = 0;
  let held = null;
  for (const [index, one] of view.canvases.entries()) {
    one.addEventListener("wheel", (event) => {
      event.preventDefault();
      view.views[index].zoom(event.deltaY < 0 ? 1.25 : 0.8, event.offsetX, event.offsetY);
      view.redrawAll();
    }, { passive: false });
    one.addEventListener("pointerdown", (event) => {
      if (index === 0 && view.measuring.active) {
        view.measuring.to(view.views[0].at(event.offsetX, event.offsetY));
        view.measuring.set();
      } else held = [event.clientX, event.clientY];
    });
    one.addEventListener("pointermove", (event) => {
      if (index === 0 && view.measuring.active && !view.measuring.result) view.measuring.to(view.views[0].at(event.offsetX, event.offsetY));
      if (!held || !view.views[index].picture) return;
      view.views[index].drag(event.clientX - held[0], event.clientY - held[1]);
      held = [event.clientX, event.clientY];
      view.redrawAll();
    });
    one.addEventListener("dblclick", () => view.fit());
  }
  addEventListener("pointerup", () => { held = null; });
}
