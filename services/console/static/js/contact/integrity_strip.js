// The data integrity strip: what has been received of the image, its resolution, and what in it is not measured.

import { h } from "../base/dom.js";
import { authentication, bytes, despeckling, duration, layerName, percent, received, sharpness } from "../base/format.js";
import { t } from "../texts.js";

function item(name, value, props = {}) {
  return h("div", props, h("dt", { text: t(`integrity_strip.${name}`) }), h("dd", { class: "number", text: value }));
}

function airtime(version) {
  if (version.airtime_s === null) return null;
  return t(version.airtime_is === "at_least" ? "integrity_strip.airtime_shared" : "integrity_strip.airtime_estimated", { time: duration(version.airtime_s) });
}

/** What the displayed image was decoded from. */
function source(version) {
  const values = { received: bytes(version.bytes_received), total: bytes(version.bytes_total), detail: sharpness(version) };
  if (version.stage === "record") return t("integrity_strip.record_only");
  if (version.missing_fraction > 0) return t("integrity_strip.with_gaps", values);
  if (version.stage === "preview") return t("integrity_strip.preview");
  if (version.stage === "part") return t("integrity_strip.part", values);
  return t(values.detail ? "integrity_strip.complete_sharp" : "integrity_strip.complete", values);
}

/** Elements for a version and the displayed layer; null if there is no version. A value that is not known is left out. */
export function integrityStrip(version, layer) {
  if (!version) return null;
  const missing = 100 * version.missing_fraction;
  const despeckled = despeckling(version);
  const detail = sharpness(version);
  const time = airtime(version);
  const receivedText = [received(version), detail ? t("integrity_strip.sharp_to", { detail }) : null].filter(Boolean).join(" · ");
  const facts = h("dl", {},
    version.authenticated === false ? item("frames_origin", t("integrity_strip.unauthenticated"), { class: "missing", title: authentication(version) }) : null,
    item("received", receivedText, { class: version.complete ? "" : "part" }),
    version.bytes_total && !version.complete ? item("bytes", t("integrity_strip.bytes_of", { received: version.bytes_received, total: bytes(version.bytes_total) })) : null,
    version.codec ? item("codec", version.codec, { title: version.model ? t("integrity_strip.model", { model: version.model }) : null }) : null,
    despeckled ? item("despeckling", despeckled, { title: t("integrity_strip.despeckling_title") }) : null,
    version.frames_received === null ? null : item("frames", String(version.frames_received)),
    time ? item("airtime", time, { title: version.airtime_is === "at_least" ? t("integrity_strip.airtime_title") : null }) : null,
    item("missing", percent(missing, missing > 0 && missing < 1 ? 1 : 0), { class: missing > 0 ? "missing" : "" }),
    version.texture ? item("texture", t(`integrity_strip.texture_${version.texture}`), { class: "guessed" }) : null,
    layer?.synthesised ? item("synthetic", t("integrity_strip.synthetic_all"), { class: "guessed" }) : null);
  const notes = version.notes.length ? h("span", { class: "muted", text: ` ${version.notes.join(" · ")}` }) : null;
  const name = layer ? layerName(version, layer.name) : layerName(version, "raw");
  const tiles = version.texture === "codebook" ? ` ${t("integrity_strip.tiles", { edge: version.texture_edge_px })}` : "";
  const statement = layer?.synthesised
    ? h("p", { class: "synthesised" }, h("b", { text: t("integrity_strip.not_a_measurement", { name }) }), ` ${layer.reason}`, notes)
    : h("p", {}, h("b", { text: `${name}: ` }), `${source(version)}${tiles}`, notes);
  return [facts, statement];
}
