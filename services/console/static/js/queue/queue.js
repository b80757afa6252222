// The review queue: a list, a film strip on small screens, or a grid of images. Only visible rows have elements, and only
// some pages of rows are loaded. Rows come from the list of the server only, so that each one matches the filter.

import { hasAlert } from "../shell/alerts.js";
import { api } from "../base/api.js";
import { debounce, fill, h, notUpdated } from "../base/dom.js";
import { emit, listen, setCounts, state } from "../base/state.js";
import { t } from "../texts.js";
import { queueRow } from "./queue_row.js";

const MARGIN_ROWS = 6; // rows drawn above and below the visible ones
const PAGE = 50;
const MAX_PAGES = 16;
const REFRESH_MS = 50; // changes in this time are one reload of the visible rows
const MAX_REFRESH_MS = 250;

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

export class Queue {
  constructor() {
    this.rows = new QueuePages();
    /** @type {Map<number, {row: object, element: HTMLElement}>} by index */
    this.drawn = new Map();
    this.selectedIndex = 0; // row of the displayed contact; in the grid, the row that Enter opens
    this.columns = 1;
    this.grid = false;
    this.refreshing = false;
    this.refreshAgain = false;
    this.loading = false; // rows for scrolling
    this.space = h("div", { class: "space", role: "presentation" });
    this.list = h("div", {
      id: "queue", class: "list", role: "listbox", tabindex: 0, "aria-label": t("queue.title"),
      on: { scroll: () => this.draw(), click: (event) => this.#clicked(event), keydown: (event) => this.#key(event) },
    }, this.space);
    this.empty = h("p", { class: "empty muted", role: "status" });
    this.element = h("div", { class: "listbox" }, this.list, this.empty);
    new ResizeObserver(() => this.#resized()).observe(this.list);
    listen("authentication", () => this.#rebuild());
    listen("contact", debounce(() => this.refresh().catch(notUpdated), REFRESH_MS, MAX_REFRESH_MS));
    listen("theme", () => this.#resized());
    listen("alerts", () => { for (const { element } of this.drawn.values()) element.classList.toggle("alert", hasAlert(element.dataset.id)); });
  }

  /** Keep the displayed contact visible when direction or size of the list change. */
  #resized() {
    const before = [this.horizontal, this.rowSize, this.columns].join();
    this.#measureRow();
    if (before !== [this.horizontal, this.rowSize, this.columns].join()) {
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
    if (state.selected !== null) await this.mark(state.selected);
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
    const before = this.#scroll;
    const line = Math.floor(before / this.rowSize);
    const top = this.rows.at(this.columns * line);
    const wasVisible = this.#isVisible(this.selectedIndex);
    const [first, last] = this.#visibleRange();
    const response = await this.rows.refresh(first, last);
    if (response === null) return;
    setCounts(response);
    emit("list", response);
    this.#showEmpty(response);
    const scrolled = this.#scroll !== before; // by the user during the request
    if (top && this.#scroll > 0) this.#keepScrollPosition(top, line);
    const index = this.rows.indexOf(state.selected);
    if (index >= 0) this.selectedIndex = index;
    this.draw();
    if (index >= 0 && wasVisible && !scrolled && !this.grid) this.#scrollTo(index);
  }

  /** Say why no row is shown, and offer all contacts. */
  #showEmpty({ matching, total }) {
    this.empty.classList.toggle("hidden", matching > 0 || total === 0);
    const all = h("button", { type: "button", text: t("queue.show_all", { total }), on: { click: () => emit("show_all") } });
    if (matching === 0) fill(this.empty, h("span", { text: t(this.rows.query.q ? "queue.not_found" : "queue.no_match") }), " ", all);
  }

  /** Keep the visible rows in place when new rows appear above the first one, which was in this line. */
  #keepScrollPosition(top, /** @type {number} */ line) {
    const index = this.rows.indexOf(top.id);
    if (index < 0) return;
    this.#setLength();
    this.#scroll += (Math.floor(index / this.columns) - line) * this.rowSize;
  }

  /** Show a grid of images in place of list and displayed contact, or the list again. */
  showGrid(/** @type {boolean} */ on) {
    if (this.grid === on) return;
    this.grid = on;
    emit("grid");
    this.#resized();
    this.list.focus();
  }

  /** Read direction and size of the rows from the style: a list, a film strip, or the tiles of a grid. */
  #measureRow() {
    const style = getComputedStyle(this.list);
    this.horizontal = style.getPropertyValue("--direction").trim() === "row";
    const rem_px = parseFloat(getComputedStyle(document.documentElement).fontSize);
    this.rowSize = parseFloat(style.getPropertyValue("--row")) * rem_px;
    this.columns = this.grid ? Math.max(1, Math.floor(this.list.clientWidth / (parseFloat(style.getPropertyValue("--tile")) * rem_px))) : 1;
    this.list.setAttribute("aria-orientation", this.horizontal ? "horizontal" : "vertical");
    for (const [index, { element }] of this.drawn) this.#place(element, index);
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
    const start_px = Math.floor(index / this.columns) * this.rowSize;
    const across_px = (index % this.columns) * this.list.clientWidth / this.columns;
    element.style.transform = this.horizontal ? `translateX(${start_px}px)` : `translate(${across_px}px, ${start_px}px)`;
    this.#setSize(element, this.rowSize);
    if (!this.horizontal) element.style.width = `${100 / this.columns}%`;
  }

  #visibleRange() {
    if (!this.rowSize) this.#measureRow();
    const first = Math.floor(this.#scroll / this.rowSize) - MARGIN_ROWS;
    const count = Math.ceil((this.#length || 600) / this.rowSize) + 2 * MARGIN_ROWS;
    return [Math.max(0, first) * this.columns, Math.max(0, first + count) * this.columns];
  }

  #isVisible(index) {
    const start_px = Math.floor(index / this.columns) * this.rowSize;
    return start_px + this.rowSize > this.#scroll && start_px < this.#scroll + this.#length;
  }

  #isSelected(row, index) {
    return this.grid ? index === this.selectedIndex : row.id === state.selected;
  }

  #setLength() {
    this.#setSize(this.space, Math.ceil(this.rows.matching / this.columns) * this.rowSize);
  }

  #rebuild() {
    for (const { element } of this.drawn.values()) element.remove();
    this.drawn.clear();
    this.draw();
  }

  /** Draw the visible rows, and remove the others. An element stays while its row is the same. */
  draw() {
    this.#setLength();
    const count = this.rows.matching;
    const [first, end] = this.#visibleRange();
    const last = Math.min(end, count - 1);
    for (const [index, { element }] of this.drawn) {
      if (index < first || index > last) {
        element.remove();
        this.drawn.delete(index);
      }
    }
    let missing = false;
    for (let index = first; index <= last; index += 1) {
      const row = this.rows.at(index);
      const known = this.drawn.get(index);
      missing ||= !row;
      if (!row || known?.row === row) continue;
      if (known && JSON.stringify(known.row) === JSON.stringify(row)) {
        known.row = row;
        known.element.setAttribute("aria-setsize", String(count));
        continue;
      }
      const element = queueRow(row, index, count, this.#isSelected(row, index));
      this.#place(element, index);
      element.classList.toggle("fresh", known?.row.id === row.id);
      if (known) known.element.replaceWith(element);
      else this.space.append(element);
      this.drawn.set(index, { row, element });
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
    } catch (error) {
      notUpdated(error);
    } finally {
      this.loading = false;
    }
    if (response || generation !== this.rows.generation) this.draw();
  }

  #updateActiveRow() {
    let active = null;
    for (const [index, { element }] of this.drawn) {
      const selected = this.#isSelected(element.dataset, index);
      element.setAttribute("aria-selected", String(selected));
      if (selected) active = element;
    }
    if (active) this.list.setAttribute("aria-activedescendant", active.id);
    else this.list.removeAttribute("aria-activedescendant");
  }

  /** Mark the displayed contact, and scroll to it, also to a row that is not loaded. */
  async mark(id) {
    this.#updateActiveRow();
    if (!this.rows.generation) return;
    let index = this.rows.indexOf(id);
    if (index < 0) ({ index } = await api.contacts({ ...this.rows.query, find: id, limit: 1 }));
    if (index === null || state.selected !== id) return;
    this.selectedIndex = index;
    this.#scrollTo(index);
  }

  /** Keys of the grid: arrows choose an image, Enter opens it. */
  #key(event) {
    if (!this.grid) return;
    const step = { ArrowLeft: -1, ArrowRight: 1, ArrowUp: -this.columns, ArrowDown: this.columns }[event.key];
    const row = this.rows.at(this.selectedIndex);
    if (step) this.#scrollTo(this.selectedIndex = Math.max(0, Math.min(this.rows.matching - 1, this.selectedIndex + step)));
    else if (event.key === "Enter" && row) emit("select", row);
    else return;
    event.preventDefault();
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
  rowAfter(id, step) {
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
    const start = Math.floor(index / this.columns) * this.rowSize;
    if (start < this.#scroll) this.#scroll = start;
    else if (start + this.rowSize > this.#scroll + this.#length) this.#scroll = start + this.rowSize - this.#length;
    this.draw();
  }
}
