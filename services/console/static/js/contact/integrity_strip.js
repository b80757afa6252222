// What qualifies the image: one line below it, and the rest for the details.

import { h } from "../base/dom.js";
import { bytes, despeckling, duration, known, percent, probability, received, sharpness } from "../base/format.js";
import { t } from "../texts.js";

/** Received bytes, of the announced ones while there are more. */
function receivedBytes(/** @type {Version} */ version) {
  if (version.stage === "part") return t("integrity_strip.bytes_of", { received: version.bytes_received, total: bytes(version.bytes_total) });
  return version.stage === "sent" ? bytes(version.bytes_received) : received(version);
}

/** Elements of the line below the image: bytes, smallest detail, despeckling, missing area, probability. Unknown values are left out. */
export function qualityLine(version, contact) {
  if (!version) return [];
  const missing = 100 * version.missing_fraction;
  const detail = sharpness(version);
  const parts = [
    [receivedBytes(version), version.complete ? "" : "part"],
    detail ? [t("integrity_strip.sharp_to", { detail })] : null,
    known(version.despeckle_strength) ? [t(version.despeckle_strength > 0 ? "integrity_strip.despeckled" : "format.not_despeckled")] : null,
    version.codec ? [t("integrity_strip.missing", { missing: percent(missing, missing > 0 && missing < 1 ? 1 : 0) }), missing > 0 ? "missing" : ""] : null,
    version.texture ? [t("integrity_strip.tiles", { edge: version.texture_edge_px }), "part"] : null,
    probability(contact) ? [probability(contact), "probability"] : null,
  ];
  return parts.filter(Boolean).map(([text, name = ""]) => h("span", { class: name, text }));
}

function airtime(/** @type {Version} */ version) {
  if (version.airtime_s === null) return null;
  return t(version.airtime_is === "at_least" ? "integrity_strip.airtime_shared" : "integrity_strip.airtime_estimated", { time: duration(version.airtime_s) });
}

/** Further facts about an image, as elements of a list of terms; an unknown value is left out. */
export function imageFacts(/** @type {Version} */ version) {
  if (!version) return [];
  const facts = [
    ["codec", version.codec && [version.codec, version.model].filter(Boolean).join(", ")], ["despeckling", despeckling(version)],
    ["frames", version.frames_received], ["airtime", airtime(version)], ["sha256", version.sha256.slice(0, 12)], ["notes", version.notes.join(" · ")],
  ];
  return facts.filter(([, value]) => value).map(([name, value]) => [h("dt", { text: t(`integrity_strip.${name}`) }), h("dd", { text: String(value) })]);
}
