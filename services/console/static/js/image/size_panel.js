// Length, width, shadow and height of the contact, as measured; the next step of a measurement.

import { fill, h } from "../base/dom.js";
import { DASH, withSigma } from "../base/format.js";
import { KINDS } from "./measurement.js";
import { t } from "../texts.js";

/** Draw the panel. `size`: measured values of the server by kind. */
export function drawSizePanel(view, element) {
  const { measurement, detail } = view;
  const size = detail?.size ?? {};
  const locked = view.measurementLock();
  // New buttons would lose a click. They are created only after a change.
  const drawn = JSON.stringify([size, measurement.kind, measurement.from !== null, measurement.result, locked]);
  if (element.dataset.drawn === drawn) return;
  element.dataset.drawn = drawn;
  element.classList.toggle("used", Object.values(size).some((value) => value));
  const focused = document.activeElement?.dataset?.size;
  const fields = KINDS.map((kind) => {
    const value = size[kind];
    const live = measurement.kind === kind && measurement.result ? measurement.result : null;
    return h("span", { class: `size ${measurement.kind === kind ? "active" : ""}`, data: { kind } },
      h("button", {
        type: "button", data: { size: kind }, "aria-pressed": String(measurement.kind === kind), "aria-disabled": locked ? "true" : null,
        title: t("measure.start", { kind: t(`measure.${kind}`) }), on: { click: () => view.startMeasurement(kind) },
      }, t(`measure.${kind}`)),
      h("b", { class: "number", text: live ? withSigma(live.value_m, live.sigma_m) : value ? withSigma(value.value_m, value.sigma_m) : DASH }),
      value && !live && !locked ? h("button", {
        type: "button", class: "withdraw", data: { size: `withdraw-${kind}` }, "aria-label": t("measure.withdraw", { kind: t(`measure.${kind}`) }),
        title: t("measure.withdraw", { kind: t(`measure.${kind}`) }), on: { click: () => view.withdraw(value.measurement) },
      }, "✕") : null);
  });
  const height = measurement.kind === "shadow" && measurement.result ? { value_m: measurement.result.height_m, sigma_m: measurement.result.height_sigma_m } : size.height;
  fields.push(h("span", { class: "size", data: { kind: "height" } }, t("measure.height"), " ", h("b", { class: "number", text: withSigma(height?.value_m, height?.sigma_m) })));
  fill(element, h("div", { class: "sizes" }, fields), measurement.active ? hint(view) : null);
  if (focused) element.querySelector(`[data-size="${CSS.escape(focused)}"]`)?.focus();
}

/**
 * Instruction for the next step, with the button that keeps a result.
 * @param {any} view view of the contact
 * @returns {HTMLElement}
 */
function hint(view) {
  const { measurement } = view;
  if (measurement.result) {
    return h("p", { class: "hint", role: "status" }, `${t(measurement.result.snapped.includes(false) ? "measure.no_edge" : "measure.keep_hint")} `,
      h("button", { type: "button", class: "primary", data: { size: "keep" }, on: { click: () => measurement.keep() } }, t("measure.keep")));
  }
  const next = KINDS[KINDS.indexOf(measurement.kind) + 1];
  return h("p", { class: "hint", role: "status" }, `${t(measurement.from ? "measure.second_end" : "measure.first_end")} `,
    h("kbd", { text: "m" }), ` ${next ? t("measure.next", { kind: t(`measure.${next}`) }) : t("measure.last")}`);
}
