// The honesty strip: by what a picture came, how much of it, and what of it nobody measured.

import { h } from "./dom.js";
import { bytes, duration, percent, received } from "./format.js";

function item(name, value, props = {}) {
  return h("div", props, h("dt", { text: name }), h("dd", { class: "number", text: value }));
}

/** Elements for one version and the layer on the screen; null where there is none. */
export function honestyStrip(version, layer) {
  if (!version) return null;
  const airtime = version.airtime_s === null ? "not known" : `${version.airtime_is === "estimated" ? "≈ " : ""}${duration(version.airtime_s)}`;
  const missing = 100 * version.missing_fraction;
  const guessed = 100 * (version.guessed_fraction ?? 0);
  const facts = h("dl", {},
    item("codec", version.codec || "none", { title: version.model ? `model ${version.model}` : "no model" }),
    item("bytes", version.bytes_total ? `${version.bytes_received} of ${bytes(version.bytes_total)}` : bytes(version.bytes_received)),
    item("frames", String(version.frames_received)),
    item("air time", airtime),
    item("received", received(version), { class: version.complete ? "" : "part" }),
    item("missing", percent(missing, missing > 0 && missing < 1 ? 1 : 0), { class: missing > 0 ? "missing" : "" }),
    item("guessed", layer?.synthesised ? "all of it" : percent(guessed, guessed > 0 && guessed < 1 ? 1 : 0), { class: guessed > 0 || layer?.synthesised ? "guessed" : "" }));
  const said = version.complete ? "as the codec's stream says, all of it received." : missing > 0 ? "as the codec's stream says; hatched areas were never received." : "as the codec's stream says so far; detail is still to come.";
  const notes = version.notes.length ? h("span", { class: "muted", text: ` ${version.notes.join(" · ")}` }) : null;
  const truth = layer?.synthesised
    ? h("p", { class: "made" }, h("b", { text: `✱ ${layer.name}: not a measurement. ` }), layer.reason, notes)
    : h("p", { class: "measured" }, h("b", { text: `${layer?.name ?? "raw"}: ` }), said, notes);
  return [facts, truth];
}
