// Filter and order of the review queue.

import { fill, h, labelled } from "../base/dom.js";
import { symbol, verdict } from "../base/format.js";
import { opener } from "../base/layout.js";
import { setting, state } from "../base/state.js";
import { t } from "../texts.js";

const REVIEWS = ["to_do", "", "mine_like", "not_mine_like", "unsure", "newer_detail"];
const SORTS = ["arrived desc", "confidence desc", "received desc", "received asc", "updated desc", "range asc", "vehicle asc", "name asc", "review asc"];
const CONFIDENCES = ["", "0.5", "1", "1.5"];

/** Button of a verdict: its symbol, named for screen readers. */
function reviewChip(value, chosen, handler) {
  const text = { to_do: t("queue_filters.unreviewed"), "": t("queue_filters.all") }[value];
  const label = value === "newer_detail" ? t("object.filter") : text ?? verdict(value);
  return h("button", {
    type: "button", data: { review: value }, "aria-pressed": String(chosen), "aria-label": label, title: label, text: value === "newer_detail" ? "+B" : text ?? symbol(value), on: { click: handler },
  });
}

export class QueueFilters {
  constructor(changed) {
    this.changed = changed;
    this.review = setting("review") ?? "to_do";
    this.chips = REVIEWS.map((value) => reviewChip(value, value === this.review, () => this.setReview(value)));
    this.search = h("input", { type: "search", id: "search", placeholder: t("queue_filters.search"), "aria-label": t("queue_filters.search_label"), maxlength: 80, on: { input: () => changed() } });
    this.sort = h("select", { id: "sort", on: { change: () => { setting("sort", this.sort.value); changed(); } } },
      SORTS.map((value) => h("option", { value, text: t(`queue_filters.sort.${value.replace(" ", "_")}`) })));
    this.sort.value = setting("sort") ?? "arrived desc";
    if (!this.sort.value) this.sort.value = "arrived desc";
    this.vehicle = h("select", { id: "vehicle", on: { change: () => changed() } }, this.#allVehicles());
    this.confidence = h("select", { id: "confidence", on: { change: () => changed() } },
      CONFIDENCES.map((value) => h("option", { value, text: value ? t("queue_filters.confidence_at_least", { value }) : t("queue_filters.any_confidence") })));
    this.completeOnly = h("input", { type: "checkbox", id: "whole", on: { change: () => changed() } });
    this.summary = h("span", { class: "number", "aria-live": "polite" });
    const more = h("button", { type: "button", class: "filter-button", "aria-label": t("queue_filters.more"), title: t("queue_filters.more"), text: "⚙" });
    this.element = h("form", { class: "filters", role: "search", "aria-label": t("queue_filters.title"), on: { submit: (event) => event.preventDefault() } },
      h("div", { class: "chips", role: "group", "aria-label": t("queue_filters.verdict") }, this.chips), this.search,
      h("div", { class: "fields" },
        labelled(t("queue_filters.sort"), this.sort), labelled(t("queue_filters.vehicle"), this.vehicle), labelled(t("queue_filters.confidence"), this.confidence),
        h("label", { class: "whole" }, this.completeOnly, ` ${t("queue_filters.complete")}`)),
      h("div", { class: "sum" }, this.summary, more));
    this.menu = opener(more, this.element);
  }

  #allVehicles() {
    return h("option", { value: "", text: t("queue_filters.all_vehicles") });
  }

  setReview(value) {
    this.review = setting("review", value);
    for (const chip of this.chips) chip.setAttribute("aria-pressed", String(chip.dataset.review === value));
    this.changed();
  }

  /** Focus the search field, which may be in the closed menu. */
  openSearch() {
    if (!this.search.checkVisibility()) this.menu.open();
    this.search.focus();
    this.search.select();
  }

  get query() {
    const [sort, order] = this.sort.value.split(" ");
    return {
      sort, order, review: this.review, vehicle: this.vehicle.value, min_confidence: this.confidence.value, complete: this.completeOnly.checked ? "true" : "",
      q: this.search.value.trim(),
    };
  }

  /** Update the counts and the list of vehicles. */
  update({ matching, vehicles }) {
    this.summary.textContent = t("queue_filters.summary", { matching, total: state.total });
    if (vehicles.join() === [...this.vehicle.options].slice(1).map((one) => one.value).join()) return;
    const chosen = this.vehicle.value;
    fill(this.vehicle, this.#allVehicles(), vehicles.map((name) => h("option", { value: name, text: name })));
    this.vehicle.value = vehicles.includes(chosen) ? chosen : "";
  }
}
