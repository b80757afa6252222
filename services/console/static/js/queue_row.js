// One row of the review queue.

import { h } from "./dom.js";
import { DASH, quantity, received, symbol, time, verdict } from "./format.js";

function bar(share, words, tone) {
  const inner = h("span", {});
  inner.style.width = `${Math.max(0, Math.min(100, share))}%`;
  return h("span", { class: `meter ${tone}`, title: words, "aria-hidden": "true" }, inner);
}

/** What a screen reader says of a row. */
export function rowWords(row) {
  return [
    row.name, verdict(row.review), row.atd_confidence === null ? "no detector confidence" : `detector ${row.atd_confidence.toFixed(2)} of 2`,
    row.complete ? "picture complete" : `${received(row)} received`, `seen ${time(row.seen_utc_s ?? row.first_frame_utc_s)}`,
    row.looks > 1 ? `${row.looks} looks at one place` : "", row.advised ? "advice from shore" : "",
  ].filter(Boolean).join(", ");
}

function marks(row) {
  const list = [];
  if (row.looks > 1) list.push(h("span", { class: "mark", title: `${row.looks} looks at one place` }, `×${row.looks}`));
  if (row.advised) list.push(h("span", { class: "mark", title: "Advice from shore" }, "✉"));
  if (row.open_requests > 0) list.push(h("span", { class: "mark", title: "Asked for more; not here yet" }, "⟳"));
  if (row.delivery?.vehicle === "confirmed" && ["delivered", "none"].includes(row.delivery?.shore)) {
    list.push(h("span", { class: "mark good", title: "The decision is ashore and on the vehicle" }, "✓"));
  }
  if ([row.delivery?.vehicle, row.delivery?.shore].some((step) => step === "refused" || step === "expired")) {
    list.push(h("span", { class: "mark bad", title: "The decision was not delivered" }, "!"));
  }
  return list;
}

/** Make the element of a row; `index` counts from 0, `count` is the length of the whole list. */
export function queueRow(row, index, count, selected) {
  const picture = row.has_picture
    ? h("img", { src: row.thumbnail, alt: "", decoding: "async" })
    : h("span", { class: "nothing", text: "no picture yet" });
  return h("div", {
    id: `row-${index}`, class: "row", role: "option", "aria-selected": String(selected), "aria-posinset": index + 1, "aria-setsize": count,
    "aria-label": rowWords(row), data: { id: row.id, index: String(index), review: row.review },
  },
  h("div", { class: "thumb" }, picture),
  h("div", { class: "words" },
    h("div", { class: "first" },
      h("b", { text: row.name }),
      h("span", { class: `badge ${row.review}` }, h("span", { text: symbol(row.review) }), ` ${verdict(row.review)}`)),
    h("div", { class: "second number" },
      h("span", { text: `ATD ${row.atd_confidence === null ? DASH : row.atd_confidence.toFixed(2)}` }),
      bar((row.atd_confidence ?? 0) * 50, "detector's confidence, 0 to 2", "atd"),
      h("span", { class: "share", text: received(row) }),
      bar(row.percent_received ?? 0, "received", row.complete ? "whole" : "part")),
    h("div", { class: "third muted number" },
      h("span", { text: time(row.seen_utc_s ?? row.first_frame_utc_s) }),
      h("span", { text: quantity(row.range_m, "m", 0) }),
      h("span", { class: "marks" }, marks(row)))));
}
