// The review queue. Only visible rows have elements, and only some pages of rows are loaded.

import { hasAlert } from "../shell/alerts.js";
import { api } from "../base/api.js";
import { h } from "../base/dom.js";
import { DASH, authentication, probabilities, quantity, received, symbol, time, verdict } from "../base/format.js";
import { decidedOnLess } from "../views/object_view.js";
import { emit, listen, state } from "../base/state.js";
import { t } from "../texts.js";

const MARGIN_ROWS = 6; // rows drawn above and below the visible ones
const PAGE = 100;
const MAX_PAGES = 8;

/** Rows of the queue, loaded in pages. */
class QueuePages {
  constructor() {
    this.query = {};
    this.matching = 0;
    this.vehicles = [];
    this.pages = new Map(); // page number → rows, least recently used first
    this.generation = 0;
  }

  /** Row at an index; undefined if not loaded. */
  at(index) {
    return this.pages.get(Math.floor(index / PAGE))?.[index % PAGE];
  }

  /** Index of a contact; -1 if not loaded. */
  indexOf(id) {
    for (const [number, rows] of this.pages) {
      const within = rows.findIndex((row) => row.id === id);
      if (within >= 0) return number * PAGE + within;
    }
    return -1;
  }

  /** Replace the row of a contact; returns whether it was loaded. */
  replace(row) {
    const index = this.indexOf(row.id);
    if (index < 0) return false;
    this.pages.get(Math.floor(index / PAGE))[index % PAGE] = row;
    return true;
  }

  async #load(number) {
    const generation = this.generation;
    const response = await api.contacts({ ...this.query, offset: number * PAGE, limit: PAGE });
    if (generation !== this.generation) return null;
    return response;
  }

  #store(number, rows) {
    this.pages.delete(number);
    this.pages.set(number, rows);
    while (this.pages.size > MAX_PAGES) this.pages.delete(this.pages.keys().next().value);
  }

  /** Load the rows first…last if necessary; returns the last response, null if all were loaded. */
  async ensure(first, last) {
    let response = null;
    for (let number = Math.floor(first / PAGE); number <= Math.floor(last / PAGE); number += 1) {
      if (this.pages.has(number)) {
        this.#store(number, this.pages.get(number));
        continue;
      }
      const page = await this.#load(number);
      if (page === null) return null;
      this.#store(number, page.items);
      this.#setCounts(page);
      response = page;
    }
    return response;
  }

  /** Reload the pages of the rows first…last, and discard all others: their rows may have moved. */
  async refresh(first, last) {
    this.generation += 1;
    const fresh = new Map();
    let response = null;
    for (let number = Math.floor(first / PAGE); number <= Math.floor(last / PAGE); number += 1) {
      response = await this.#load(number);
      if (response === null) return null;
      fresh.set(number, response.items);
      if (number * PAGE >= response.matching) break;
    }
    this.pages = fresh;
    this.#setCounts(response);
    return response;
  }

  #setCounts(response) {
    this.matching = response.matching;
    this.vehicles = response.vehicles;
  }
}

function meter(value_percent, title, tone) {
  const inner = h("span", {});
  inner.style.width = `${Math.max(0, Math.min(100, value_percent))}%`;
  return h("span", { class: `meter ${tone}`, title, "aria-hidden": "true" }, inner);
}

/** Label of a row for screen readers. */
function rowLabel(row) {
  return [
    row.name, verdict(row.review), row.atd_confidence === null ? t("queue.no_confidence") : t("queue.confidence_label", { value: row.atd_confidence.toFixed(2) }),
    row.atd_class ? t("queue.class_label", { name: row.atd_class }) : "", probabilities(row) ?? "",
    received(row), t("queue.seen", { time: time(row.seen_utc_s ?? row.first_frame_utc_s) }),
    row.looks > 1 ? t("queue.looks", { count: row.looks }) : "", row.contradictory ? t("object.contradictory") : "", decidedOnLess(row) ?? "", row.advised ? t("queue.advised") : "",
    row.authenticated === false ? t("queue.unauthenticated") : "",
  ].filter(Boolean).join(", ");
}

/** Class of the detector; a structure has a frame. */
function classMark(row) {
  if (!row.atd_class) return null;
  const title = probabilities(row) ?? t("queue.class");
  return h("span", { class: row.atd_class === "structure" ? "class structure" : "class", title, text: row.atd_class });
}

function marks(row) {
  const list = [];
  if (row.authenticated === false) list.push(h("span", { class: "mark bad unauthenticated", title: authentication(row) }, "⚠"));
  if (row.looks > 1) list.push(h("span", { class: "mark", title: t("queue.looks", { count: row.looks }) }, `×${row.looks}`));
  if (row.contradictory) list.push(h("span", { class: "mark contradiction", title: t("object.contradictory") }, "▲○"));
  if (row.advised) list.push(h("span", { class: "mark", title: t("queue.advised") }, "✉"));
  if (row.open_requests > 0) list.push(h("span", { class: "mark", title: t("queue.open_request") }, "⟳"));
  if (row.delivery?.vehicle === "confirmed" && ["delivered", "none"].includes(row.delivery?.shore)) {
    list.push(h("span", { class: "mark good", title: t("queue.delivered") }, "✓"));
  }
  if ([row.delivery?.vehicle, row.delivery?.shore].some((step) => step === "refused" || step === "expired")) {
    list.push(h("span", { class: "mark bad", title: t("queue.not_delivered") }, "!"));
  }
  return list;
}

/** Element of a row; `index` counts from 0, `count` is the length of the list. */
function queueRow(row, index, count, selected) {
  const image = row.has_picture
    ? h("img", { src: row.thumbnail, alt: "", decoding: "async" })
    : h("span", { class: "nothing", text: t("queue.no_image") });
  return h("div", {
    id: `row-${index}`, class: hasAlert(row.id) ? "row alert" : "row", role: "option", "aria-selected": String(selected), "aria-posinset": index + 1, "aria-setsize": count,
    "aria-label": rowLabel(row), data: { id: row.id, index: String(index), review: row.review },
  },
  h("div", { class: "thumb" }, image),
  h("div", { class: "words" },
    h("div", { class: "first" },
      h("b", { text: row.name }),
      h("span", { class: `badge ${row.review}` }, h("span", { text: symbol(row.review) }), h("span", { class: "verdict", text: ` ${verdict(row.review)}` }))),
    h("div", { class: "second number" },
      h("span", { title: t("queue.confidence"), text: t("queue.detector", { value: row.atd_confidence === null ? DASH : row.atd_confidence.toFixed(2) }) }),
      meter((row.atd_confidence ?? 0) * 50, t("queue.confidence"), "atd"),
      h("span", { class: "share", text: received(row) }),
      row.percent_received === null ? null : meter(row.percent_received, t("queue.received_title"), row.complete ? "whole" : "part")),
    h("div", { class: "third muted number" },
      h("span", { class: "time", text: time(row.seen_utc_s ?? row.first_frame_utc_s) }),
      row.newer_detail ? h("span", { class: "newer", title: t("object.newer"), text: decidedOnLess(row) }) : h("span", { class: "range", text: quantity(row.range_m, "m", 0) }),
      classMark(row),
      h("span", { class: "marks" }, marks(row)))));
}

export class Queue {
  constructor() {
    this.rows = new QueuePages();
    this.drawn = new Map(); // index → element
    this.selectedIndex = 0;
    this.refreshing = false;
    this.refreshAgain = false;
    this.loading = false; // rows for scrolling
    this.space = h("div", { class: "space", role: "presentation" });
    this.list = h("div", {
      id: "queue", class: "list", role: "listbox", tabindex: 0, "aria-label": t("queue.title"),
      on: { scroll: () => this.draw(), click: (event) => this.#clicked(event) },
    }, this.space);
    this.empty = h("p", { class: "empty muted", text: t("queue.empty") });
    this.element = h("div", { class: "listbox" }, this.list, this.empty);
    new ResizeObserver(() => this.#resized()).observe(this.list);
    listen("contact", ({ contact, new: isNew }) => this.#updateContact(contact, isNew));
    listen("theme", () => this.#resized());
    listen("alerts", () => { for (const element of this.drawn.values()) element.classList.toggle("alert", hasAlert(element.dataset.id)); });
  }

  /** Keep the displayed contact visible when direction or size of the list change. */
  #resized() {
    const before = [this.horizontal, this.rowSize];
    this.#measureRow();
    if (before[0] !== this.horizontal || before[1] !== this.rowSize) {
      this.#setLength();
      this.#scrollTo(this.selectedIndex);
    } else this.draw();
  }

  /** Show the contacts of a filter, from the first one. */
  async show(query) {
    this.rows.query = query;
    this.#scroll = 0;
    this.selectedIndex = 0;
    await this.refresh();
  }

  /** Reload the visible rows. Calls during a reload cause one more reload. */
  async refresh() {
    if (this.refreshing) {
      this.refreshAgain = true;
      return;
    }
    this.refreshing = true;
    try {
      do {
        this.refreshAgain = false;
        await this.#reload();
      } while (this.refreshAgain);
    } finally {
      this.refreshing = false;
    }
  }

  async #reload() {
    const top = this.rows.at(Math.floor(this.#scroll / this.rowSize));
    const [first, last] = this.#visibleRange();
    const response = await this.rows.refresh(first, last);
    if (response === null) return;
    Object.assign(state, { total: response.total, unreviewed: response.unreviewed });
    emit("counts", response);
    if (top && this.#scroll > 0) this.#keepScrollPosition(top);
    const index = this.rows.indexOf(state.selected);
    if (index >= 0) this.selectedIndex = index;
    this.#redraw();
  }

  /** Keep the visible rows in place when new rows appear above them. */
  #keepScrollPosition(top) {
    const index = this.rows.indexOf(top.id);
    if (index < 0) return;
    const within = this.#scroll % this.rowSize;
    this.#setLength();
    this.#scroll = index * this.rowSize + within;
  }

  #updateContact(row, isNew) {
    const matches = !this.rows.query.review || this.rows.query.review === row.review
      || (this.rows.query.review === "mine_like" && row.review === "disputed")
      || (this.rows.query.review === "to_do" && (row.review === "unreviewed" || row.contradictory))
      || (this.rows.query.review === "newer_detail" && row.newer_detail)
      || (this.rows.query.review === "reviewed" && row.review !== "unreviewed");
    // Contradictory contacts come first.
    const moves = this.rows.at(this.rows.indexOf(row.id))?.contradictory !== row.contradictory;
    const known = this.rows.replace(row);
    if (known) {
      const element = this.drawn.get(this.rows.indexOf(row.id));
      if (element) this.#replace(this.rows.indexOf(row.id), row, element);
    }
    if (isNew || moves || known !== matches || !["arrived", "name", "vehicle"].includes(this.rows.query.sort)) this.refresh();
  }

  #replace(index, row, element) {
    const fresh = queueRow(row, index, this.rows.matching, row.id === state.selected);
    this.#place(fresh, index);
    fresh.classList.add("fresh");
    element.replaceWith(fresh);
    this.drawn.set(index, fresh);
  }

  /** Read direction and size of the rows from the style: a list, or a film strip. */
  #measureRow() {
    const style = getComputedStyle(this.list);
    this.horizontal = style.getPropertyValue("--direction").trim() === "row";
    this.rowSize = parseFloat(style.getPropertyValue("--row")) * parseFloat(getComputedStyle(document.documentElement).fontSize);
    this.list.setAttribute("aria-orientation", this.horizontal ? "horizontal" : "vertical");
    for (const [index, element] of this.drawn) this.#place(element, index);
  }

  get #scroll() { return this.horizontal ? this.list.scrollLeft : this.list.scrollTop; }
  set #scroll(value) { this.list[this.horizontal ? "scrollLeft" : "scrollTop"] = value; }
  get #length() { return this.horizontal ? this.list.clientWidth : this.list.clientHeight; }

  /** Set a size along the direction of the list, and remove the one across. */
  #setSize(element, size_px) {
    element.style.width = this.horizontal ? `${size_px}px` : "";
    element.style.height = this.horizontal ? "" : `${size_px}px`;
  }

  #place(element, index) {
    element.style.transform = `translate${this.horizontal ? "X" : "Y"}(${index * this.rowSize}px)`;
    this.#setSize(element, this.rowSize);
  }

  #visibleRange() {
    if (!this.rowSize) this.#measureRow();
    const first = Math.floor(this.#scroll / this.rowSize) - MARGIN_ROWS;
    const count = Math.ceil((this.#length || 600) / this.rowSize) + 2 * MARGIN_ROWS;
    return [Math.max(0, first), Math.max(0, first + count)];
  }

  #setLength() {
    this.#setSize(this.space, this.rows.matching * this.rowSize);
  }

  #redraw() {
    for (const element of this.drawn.values()) element.remove();
    this.drawn.clear();
    this.draw();
  }

  /** Draw the visible rows, and remove the others. */
  draw() {
    this.#setLength();
    this.empty.classList.toggle("hidden", this.rows.matching > 0);
    const [first, end] = this.#visibleRange();
    const last = Math.min(end, this.rows.matching - 1);
    for (const [index, element] of this.drawn) {
      if (index < first || index > last) {
        element.remove();
        this.drawn.delete(index);
      }
    }
    let missing = false;
    for (let index = first; index <= last; index += 1) {
      const row = this.rows.at(index);
      missing ||= !row;
      if (this.drawn.has(index) || !row) continue;
      const element = queueRow(row, index, this.rows.matching, row.id === state.selected);
      this.#place(element, index);
      this.space.append(element);
      this.drawn.set(index, element);
    }
    this.#updateActiveRow();
    if (missing) this.#loadVisible(first, last);
  }

  /** Load rows and draw them. Scrolling during a load starts no other one: the rows visible at its end are loaded next. */
  async #loadVisible(first, last) {
    if (this.loading) return;
    this.loading = true;
    const { generation } = this.rows;
    let response = null;
    try {
      response = await this.rows.ensure(first, last);
    } finally {
      this.loading = false;
    }
    if (response || generation !== this.rows.generation) this.draw();
  }

  #updateActiveRow() {
    const active = [...this.drawn.values()].find((element) => element.dataset.id === state.selected);
    if (active) this.list.setAttribute("aria-activedescendant", active.id);
    else this.list.removeAttribute("aria-activedescendant");
  }

  /** Mark the displayed contact, and scroll to it. */
  mark(id) {
    const index = this.rows.indexOf(id);
    if (index >= 0) {
      this.selectedIndex = index;
      this.#scrollTo(index);
    }
    for (const element of this.drawn.values()) element.setAttribute("aria-selected", String(element.dataset.id === id));
    this.#updateActiveRow();
  }

  #clicked(event) {
    const element = event.target.closest("[data-id]");
    const row = element && this.rows.at(Number(element.dataset.index));
    if (row) emit("select", row);
  }

  /** Move the selection by `step` rows. */
  move(step) {
    emit("move", { step });
  }

  /** Row `step` rows after a contact; null in an empty list. The successor of a contact that has left the list is the next one. */
  async rowAfter(id, step) {
    const known = this.rows.indexOf(id);
    if (known >= 0) return this.#row(known + step);
    return this.#row(id === null ? 0 : this.selectedIndex + (step > 0 ? step - 1 : step));
  }

  async #row(requested) {
    if (this.rows.matching === 0) return null;
    const index = Math.max(0, Math.min(this.rows.matching - 1, requested));
    await this.rows.ensure(index, index);
    return this.rows.at(index) ?? null;
  }

  /** Loaded rows after a contact. */
  following(id, count) {
    const index = this.rows.indexOf(id);
    return index < 0 ? [] : Array.from({ length: count }, (_, i) => this.rows.at(index + 1 + i)).filter(Boolean);
  }

  /** Next row without a decision: of the loaded rows below a contact, else the first one of the queue; null if there is none. */
  async nextUnreviewed(id, excluded = []) {
    const open = (row) => row.review === "unreviewed" && row.id !== id && !excluded.includes(row.id);
    const known = this.rows.indexOf(id);
    for (let index = known >= 0 ? known + 1 : this.selectedIndex; index < this.rows.matching && this.rows.at(index); index += 1) {
      if (open(this.rows.at(index))) return this.rows.at(index);
    }
    const { items } = await api.contacts({ ...this.rows.query, review: "unreviewed", offset: 0, limit: excluded.length + 2 });
    return items.find(open) ?? null;
  }

  #scrollTo(index) {
    const start = index * this.rowSize;
    if (start < this.#scroll) this.#scroll = start;
    else if (start + this.rowSize > this.#scroll + this.#length) this.#scroll = start + this.rowSize - this.#length;
    this.draw();
  }
}
