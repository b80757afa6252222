// The data integrity strip: codec, received and missing parts, and whether the displayed layer is measurable.

import { h } from "./dom.js";
import { authentication, bytes, despeckling, duration, percent, received } from "./format.js";

const DESPECKLING = "The vehicle estimates the image without speckle and sends the estimate. The request \u201cunfiltered image\u201d sends the image without this step.";

function item(name, value, props = {}) {
  return h("div", props, h("dt", { text: name }), h("dd", { class: "number", text: value }));
}

/** Elements for a version and the displayed layer; null if there is no version. */
export function integrityStrip(version, layer) {
  if (!version) return null;
  const airtime = version.airtime_s === null ? "unknown" : `${version.airtime_is === "estimated" ? "≈ " : ""}${duration(version.airtime_s)}`;
  const missing = 100 * version.missing_fraction;
  const guessed = 100 * (version.guessed_fraction ?? 0);
  const despeckled = despeckling(version);
  const facts = h("dl", {},
    version.authenticated === false ? item("acoustic frames", "unauthenticated", { class: "missing", title: authentication(version) }) : null,
    item("codec", version.codec || "none", { title: version.model ? `model ${version.model}` : "no model" }),
    despeckled ? item("despeckling", despeckled, { title: DESPECKLING }) : null,
    item("bytes", version.bytes_total ? `${version.bytes_received} of ${bytes(version.bytes_total)}` : bytes(version.bytes_received)),
    item("frames", String(version.frames_received)),
    item("air time", airtime),
    item("received", received(version), { class: version.complete ? "" : "part" }),
    item("missing", percent(missing, missing > 0 && missing < 1 ? 1 : 0), { class: missing > 0 ? "missing" : "" }),
    item("synthetic", layer?.synthesised ? "all" : percent(guessed, guessed > 0 && guessed < 1 ? 1 : 0), { class: guessed > 0 || layer?.synthesised ? "guessed" : "" }));
  const source = version.complete ? "decoded from the complete stream." : missing > 0 ? "decoded from the received part; hatched areas were never received." : "decoded from the received part; more detail follows.";
  const notes = version.notes.length ? h("span", { class: "muted", text: ` ${version.notes.join(" · ")}` }) : null;
  const statement = layer?.synthesised
    ? h("p", { class: "synthesised" }, h("b", { text: `✱ ${layer.name}: not a measurement. ` }), layer.reason, notes)
    : h("p", {}, h("b", { text: `${layer?.name ?? "raw"}: ` }), source, notes);
  return [facts, statement];
}
