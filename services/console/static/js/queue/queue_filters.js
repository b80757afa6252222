// Filter and order of the review queue.

import { fill, h, labelled } from "../base/dom.js";
import { secondsOf } from "../base/format.js";
import { opener } from "../base/layout.js";
import { setting, state } from "../base/state.js";
import { t } from "../texts.js";

const REVIEWS = ["to_do", "all", "mine_like", "not_mine_like", "unsure", "undelivered", "newer_detail", "watch"];
const SORTS = ["arrived desc", "confidence desc", "received desc", "received asc", "updated desc", "range asc", "name asc"];

const select = (id, values, textOf, changed) => h("select", { id, on: { change: changed } }, values.map((value) => h("option", { value, text: textOf(value) })));

export class QueueFilters {
  /** `changed()` is called after a change, `grid()` to show a grid of images or the list. */
  constructor(changed, grid) {
    this.changed = changed;
    this.reviews = select("review", REVIEWS, (value) => t(`queue_filters.review.${value}`), () => this.setReview(this.reviews.value));
    this.reviews.setAttribute("aria-label", t("queue_filters.title"));
    this.reviews.value = setting("review") ?? "to_do";
    if (!this.reviews.value) this.reviews.value = "all";
    this.search = h("input", {
      type: "search", id: "search", placeholder: t("queue_filters.search"), "aria-label": t("queue_filters.search_label"), maxlength: 80,
      // Not all browsers send "input" when they clear the field, and not all clear it at Escape.
      on: { input: changed, search: changed, keydown: (event) => { if (event.key === "Escape") this.clearSearch(); } },
    });
    this.sort = select("sort", SORTS, (value) => t(`queue_filters.sort.${value.replace(" ", "_")}`), () => { setting("sort", this.sort.value); changed(); });
    this.sort.value = setting("sort") ?? SORTS[0];
    if (!this.sort.value) this.sort.value = SORTS[0];
    this.vehicle = h("select", { id: "vehicle", on: { change: changed } }, this.#allVehicles());
    const time = (/** @type {string} */ id) => h("input", { type: "datetime-local", id, on: { change: changed } });
    this.from = time("from");
    this.to = time("to");
    this.summary = h("span", { class: "number", "aria-live": "polite" });
    const button = (name, text, handler) => h("button", { type: "button", class: `${name}-button`, "aria-label": t(`queue_filters.${name}`), title: t(`queue_filters.${name}`), text, on: { click: handler } });
    const more = button("filter", "⚙", () => {});
    this.element = h("form", { class: "filters", role: "search", "aria-label": t("queue_filters.title"), on: { submit: (event) => event.preventDefault() } },
      this.reviews, this.search,
      h("div", { class: "fields" },
        labelled(t("queue_filters.sort"), this.sort), labelled(t("queue_filters.vehicle"), this.vehicle),
        labelled(t("queue_filters.from"), this.from), labelled(t("queue_filters.to"), this.to)),
      h("div", { class: "sum" }, this.summary, button("grid", "▦", grid), more));
    this.menu = opener(more, this.element);
  }

  #allVehicles() {
    return h("option", { value: "", text: t("queue_filters.all_vehicles") });
  }

  setReview(value) {
    this.reviews.value = setting("review", value);
    this.changed();
  }

  clearSearch() {
    this.search.value = "";
    this.changed();
  }

  /** Show all contacts. */
  reset() {
    for (const field of [this.search, this.vehicle, this.from, this.to]) field.value = "";
    this.setReview("all");
  }

  /** With nothing to do, as in an archive, show all contacts; the stored filter stays. */
  leaveEmptyToDo() {
    if (this.reviews.value !== "to_do") return;
    this.reviews.value = "all";
    this.changed();
  }

  /** Focus the search field, which may be in the closed menu. */
  openSearch() {
    if (!this.search.checkVisibility()) this.menu.open();
    this.search.focus();
    this.search.select();
  }

  /** The query of the list; a text is searched in all contacts. */
  get query() {
    const [sort, order] = this.sort.value.split(" ");
    const q = this.search.value.trim();
    if (q) return { sort, order, q };
    const review = this.reviews.value;
    const times = [secondsOf(this.from), review === "watch" ? state.session.begun_utc_s : null];
    return { sort, order, vehicle: this.vehicle.value, review: ["all", "watch"].includes(review) ? "" : review, from_utc_s: Math.max(...times) || null, to_utc_s: secondsOf(this.to) };
  }

  /** Update the counts and the list of vehicles. */
  update({ matching, vehicles, total }) {
    const searched = Boolean(this.search.value.trim());
    const name = searched ? "found" : total > 0 && matching === total && state.counts.to_do === 0 ? "all_reviewed" : "summary";
    this.summary.textContent = t(`queue_filters.${name}`, { matching, total });
    for (const field of [this.reviews, this.vehicle, this.from, this.to]) field.disabled = searched;
    if (vehicles.join() === [...this.vehicle.options].slice(1).map((one) => one.value).join()) return;
    const chosen = this.vehicle.value;
    fill(this.vehicle, this.#allVehicles(), vehicles.map((name) => h("option", { value: name, text: name })));
    this.vehicle.value = vehicles.includes(chosen) ? chosen : "";
  }
}
