// A row of the review queue: image, name, verdict, what the detector says, what has arrived, and marks.

import { hasAlert } from "../shell/alerts.js";
import { api } from "../base/api.js";
import { h } from "../base/dom.js";
import { authentication, className, percent, quantity, received, symbol, time, unauthenticated, verdict } from "../base/format.js";
import { decidedOnLess } from "../views/object_view.js";
import { t } from "../texts.js";

const FAILED = ["refused", "expired"];

/** What the detector says: the probability of a mine-like object; its confidence where the probability is not known. */
function likelihood(row) {
  if (row.atd_class === "structure") return h("span", { class: "class structure", title: t("queue.class"), text: className(row.atd_class) });
  if (row.p_mine_like !== null) return h("span", { class: "likelihood", text: t("queue.mine_like", { value: percent(100 * row.p_mine_like) }) });
  if (row.atd_confidence === null) return null;
  return h("span", { class: "likelihood", title: t("queue.confidence"), text: t("queue.detector", { value: quantity(row.atd_confidence, "", 2) }) });
}

/** Marks as [symbol, meaning, class]. */
function marks(row) {
  const { shore, vehicle } = row.delivery ?? {};
  return [
    unauthenticated(row) && ["⚠", authentication(row), "bad unauthenticated"],
    row.contradictory && ["▲○", t("object.contradictory"), "contradiction"],
    row.looks > 1 && [`×${row.looks}`, t("queue.looks", { count: row.looks }), ""],
    row.commented && ["✉", t("queue.commented"), ""],
    row.open_requests > 0 && ["⟳", t("queue.open_request"), ""],
    vehicle === "confirmed" && ["delivered", "none"].includes(shore) && ["✓", t("queue.delivered"), "good"],
    (FAILED.includes(shore) || FAILED.includes(vehicle)) && ["!", t("queue.not_delivered"), "bad"],
  ].filter(Boolean);
}

/** Element of a row; `index` counts from 0, `count` is the length of the list. */
export function queueRow(/** @type {Contact} */ row, index, count, selected) {
  const image = row.has_image
    ? h("img", { src: api.thumbnailUrl(row.id, row.version), alt: "", decoding: "async" })
    : h("span", { class: "nothing", text: t("queue.no_image") });
  const likely = likelihood(row);
  const arrived = received(row);
  const arrived_at = time(row.first_frame_utc_s);
  const newer = decidedOnLess(row);
  const found = marks(row);
  const label = [row.name, verdict(row.review), likely?.textContent, arrived, t("queue.arrived", { time: arrived_at }), newer, ...found.map(([, meaning]) => meaning)];
  return h("div", {
    id: `row-${index}`, class: hasAlert(row.id) ? "row alert" : "row", role: "option", "aria-selected": String(selected), "aria-posinset": index + 1, "aria-setsize": count,
    "aria-label": label.filter(Boolean).join(", "), data: { id: row.id, index: String(index), review: row.review },
  },
  h("div", { class: "thumb" }, image),
  h("div", { class: "words" },
    h("div", { class: "first" }, h("b", { text: row.name }), h("span", { class: `badge ${row.review}`, title: verdict(row.review), text: symbol(row.review) })),
    h("div", { class: "second number" }, likely, likely && " · ", h("span", { class: "share", title: t("queue.received_title"), text: arrived })),
    newer ? h("div", { class: "third newer", title: t("object.newer"), text: newer }) : null,
    h("div", { class: "third muted number" },
      h("span", { class: "time", title: t("queue.arrived", { time: arrived_at }), text: arrived_at }),
      h("span", { class: "range", text: quantity(row.range_m, "m", 0) }),
      h("span", { class: "marks" }, found.map(([text, title, tone]) => h("span", { class: `mark ${tone}`, title, text }))))));
}
