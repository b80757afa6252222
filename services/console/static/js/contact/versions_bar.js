// Buttons for the versions of the image, each with its thumbnail.

import { api } from "../base/api.js";
import { fill, h } from "../base/dom.js";
import { bytes, received, time } from "../base/format.js";
import { t } from "../texts.js";

const NEWEST = 2;

/** Draw a button for the first, the newest and the displayed version. A version that is newer than the displayed one has a badge. */
export function drawVersions(view) {
  const { versions } = view.detail;
  const focused = document.activeElement?.dataset?.version;
  const shown = versions.filter((one, index) => versions.length > 1 && (index === 0 || index >= versions.length - NEWEST || one.version === view.version));
  fill(view.versions, shown.map((one) => {
    const newer = view.version !== null && one.version > view.version;
    const label = t("versions_bar.label", { version: one.version, received: received(one), time: time(one.received_utc_s) });
    return h("button", {
      type: "button", "aria-pressed": String(one.version === view.version), title: label, data: { version: String(one.version) },
      "aria-label": newer ? `${label}, ${t("versions_bar.newer")}` : label, on: { click: () => view.showVersion(one.version) },
    },
    h("img", { src: api.thumbnailUrl(view.detail.contact.id, one.version), alt: "" }),
    h("span", { class: "number", text: one.stage === "record" ? received(one) : bytes(one.bytes_received) }),
    newer ? h("span", { class: "newer", text: t("versions_bar.new") }) : null);
  }));
  if (focused) view.versions.querySelector(`[data-version="${CSS.escape(focused)}"]`)?.focus();
}
