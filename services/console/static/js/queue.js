// The review queue: a list of which only the visible rows exist as elements, however long it is.

import { api } from "./api.js";
import { h } from "./dom.js";
import { queueRow } from "./queue_row.js";
import { Rows } from "./rows.js";
import { listen, state, tell } from "./state.js";

const SPARE = 6; // rows drawn above and below what is seen

export class Queue {
  constructor() {
    this.rows = new Rows();
    this.drawn = new Map(); // index → element
    this.selectedIndex = 0;
    this.busy = false;
    this.again = false;
    this.space = h("div", { class: "space", role: "presentation" });
    this.list = h("div", {
      id: "queue", class: "list", role: "listbox", tabindex: 0, "aria-label": "Review queue",
      on: { scroll: () => this.draw(), click: (event) => this.#clicked(event) },
    }, this.space);
    this.empty = h("p", { class: "empty muted", text: "No contact matches. Contacts appear here as their first frame arrives." });
    this.element = h("div", { class: "listbox" }, this.list, this.empty);
    new ResizeObserver(() => { this.#measureRow(); this.draw(); }).observe(this.list);
    listen("contact", ({ contact, new: isNew }) => this.#happened(contact, isNew));
    listen("theme", () => { this.#measureRow(); this.draw(); });
  }

  /** Show what a filter finds, from its top. */
  async show(query) {
    this.rows.query = query;
    this.list.scrollTop = 0;
    this.selectedIndex = 0;
    await this.refresh();
  }

  /** Load anew what is seen; calls while one is under way become one more. */
  async refresh() {
    if (this.busy) {
      this.again = true;
      return;
    }
    this.busy = true;
    try {
      do {
        this.again = false;
        await this.#reload();
      } while (this.again);
    } finally {
      this.busy = false;
    }
  }

  async #reload() {
    const top = this.rows.at(Math.floor(this.list.scrollTop / this.rowHeight));
    const [first, last] = this.#seen();
    const answer = await this.rows.refresh(first, last);
    if (answer === null) return;
    Object.assign(state, { total: answer.total, unreviewed: answer.unreviewed });
    tell("counts", answer);
    if (top && this.list.scrollTop > 0) this.#keepInPlace(top);
    const index = this.rows.indexOf(state.selected);
    if (index >= 0) this.selectedIndex = index;
    this.#redraw();
  }

  /** New rows above must not push away what the operator reads. */
  #keepInPlace(top) {
    const index = this.rows.indexOf(top.id);
    if (index < 0) return;
    const within = this.list.scrollTop % this.rowHeight;
    this.#stretch();
    this.list.scrollTop = index * this.rowHeight + within;
  }

  #happened(row, isNew) {
    const fits = !this.rows.query.review || this.rows.query.review === row.review
      || (this.rows.query.review === "reviewed" && row.review !== "unreviewed");
    const known = this.rows.merge(row);
    if (known) {
      const element = this.drawn.get(this.rows.indexOf(row.id));
      if (element) this.#replace(this.rows.indexOf(row.id), row, element);
    }
    if (isNew || known !== fits || !["arrived", "name", "vehicle"].includes(this.rows.query.sort)) this.refresh();
  }

  #replace(index, row, element) {
    const fresh = queueRow(row, index, this.rows.matching, row.id === state.selected);
    this.#place(fresh, index);
    fresh.classList.add("fresh");
    element.replaceWith(fresh);
    this.drawn.set(index, fresh);
  }

  #measureRow() {
    this.rowHeight = parseFloat(getComputedStyle(document.documentElement).fontSize) * 5.4;
    for (const [index, element] of this.drawn) this.#place(element, index);
  }

  #place(element, index) {
    element.style.transform = `translateY(${index * this.rowHeight}px)`;
    element.style.height = `${this.rowHeight}px`;
  }

  #seen() {
    if (!this.rowHeight) this.#measureRow();
    const first = Math.floor(this.list.scrollTop / this.rowHeight) - SPARE;
    const count = Math.ceil((this.list.clientHeight || 600) / this.rowHeight) + 2 * SPARE;
    return [Math.max(0, first), Math.max(0, first + count)];
  }

  #stretch() {
    this.space.style.height = `${this.rows.matching * this.rowHeight}px`;
  }

  #redraw() {
    for (const element of this.drawn.values()) element.remove();
    this.drawn.clear();
    this.draw();
  }

  /** Draw the rows that are seen, and remove the others. */
  draw() {
    this.#stretch();
    this.empty.classList.toggle("hidden", this.rows.matching > 0);
    const [first, beyond] = this.#seen();
    const last = Math.min(beyond, this.rows.matching - 1);
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
    this.#tellActive();
    if (missing) this.rows.need(first, last).then((answer) => answer && this.draw());
  }

  #tellActive() {
    const active = [...this.drawn.values()].find((element) => element.dataset.id === state.selected);
    if (active) this.list.setAttribute("aria-activedescendant", active.id);
    else this.list.removeAttribute("aria-activedescendant");
  }

  /** Mark the contact that the contact view shows. */
  mark(id) {
    for (const element of this.drawn.values()) element.setAttribute("aria-selected", String(element.dataset.id === id));
    const index = this.rows.indexOf(id);
    if (index >= 0) this.selectedIndex = index;
    this.#tellActive();
  }

  #clicked(event) {
    const element = event.target.closest("[data-id]");
    if (element) this.choose(Number(element.dataset.index));
  }

  /** Go `step` rows on. A contact that has left the list makes its successor the next one. */
  async move(step) {
    const here = this.rows.indexOf(state.selected);
    const gone = here < 0 && state.selected !== null;
    const from = here >= 0 ? here : this.selectedIndex;
    await this.choose(gone && step > 0 ? from + step - 1 : state.selected === null ? 0 : from + step);
  }

  /** Show the contact at an index, scrolling there. */
  async choose(wanted) {
    if (this.rows.matching === 0) return;
    const index = Math.max(0, Math.min(this.rows.matching - 1, wanted));
    await this.rows.need(index, index);
    const row = this.rows.at(index);
    if (!row) return;
    this.selectedIndex = index;
    this.#reveal(index);
    tell("select", { id: row.id });
  }

  /** Show the next contact that nobody has decided: of the loaded rows below, else the first of the whole queue. */
  async nextUnreviewed() {
    const [first, last] = [this.rows.indexOf(state.selected) + 1, this.rows.matching];
    for (let index = first; index < last && this.rows.at(index); index += 1) {
      if (this.rows.at(index).review === "unreviewed") {
        await this.choose(index);
        return true;
      }
    }
    const { items } = await api.contacts({ ...this.rows.query, review: "unreviewed", offset: 0, limit: 2 });
    const next = items.find((row) => row.id !== state.selected);
    if (!next) return false;
    const index = this.rows.indexOf(next.id);
    if (index >= 0) await this.choose(index);
    else tell("select", { id: next.id });
    return true;
  }

  #reveal(index) {
    const top = index * this.rowHeight;
    const height = this.list.clientHeight;
    if (top < this.list.scrollTop) this.list.scrollTop = top;
    else if (top + this.rowHeight > this.list.scrollTop + height) this.list.scrollTop = top + this.rowHeight - height;
    this.draw();
  }
}
