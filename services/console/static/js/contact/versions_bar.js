// Buttons for the versions of the image, in one row of fixed height.

import { api } from "../base/api.js";
import { fill, h } from "../base/dom.js";
import { received, time } from "../base/format.js";
import { t } from "../texts.js";

const SHOWN = 8;

/** Draw a button for each of the last versions. A version that is newer than the displayed one has a badge. */
export function drawVersions(view) {
  const { versions } = view.detail;
  const focused = document.activeElement?.dataset?.version;
  const buttons = versions.slice(-SHOWN).map((one) => {
    const newer = view.version !== null && one.version > view.version;
    const label = t("versions_bar.label", { version: one.version, received: received(one), time: time(one.received_utc_s) });
    return h("button", {
      type: "button", "aria-pressed": String(one.version === view.version), title: label, data: { version: String(one.version) },
      "aria-label": newer ? `${label}, ${t("versions_bar.newer")}` : label, on: { click: () => view.showVersion(one.version) },
    },
    h("img", { src: api.thumbnailUrl(view.detail.contact.id, one.version), alt: "" }),
    h("span", { class: "number", text: received(one) }),
    newer ? h("span", { class: "newer", text: t("versions_bar.new") }) : null);
  });
  const key = (name) => (versions.length ? h("kbd", { text: name }) : null);
  fill(view.versions, key("["), buttons, key("]"));
  if (focused) view.versions.querySelector(`[data-version="${CSS.escape(focused)}"]`)?.focus();
  view.versions.querySelector('[aria-pressed="true"]')?.scrollIntoView({ block: "nearest", inline: "nearest" });
}
