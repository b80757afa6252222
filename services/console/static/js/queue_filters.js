// Filter and order of the review queue.

import { fill, h, labelled } from "./dom.js";
import { setting, state } from "./state.js";

const REVIEWS = [["unreviewed", "to do"], ["", "all"], ["mine_like", "▲ mine"], ["not_mine_like", "○ not"], ["unsure", "? unsure"]];
const SORTS = [
  ["arrived desc", "newest first"], ["confidence desc", "ATD confidence"], ["received desc", "most received"], ["received asc", "least received"],
  ["updated desc", "last updated"], ["range asc", "nearest first"], ["vehicle asc", "vehicle"], ["name asc", "name"], ["review asc", "verdict"],
];

export class QueueFilters {
  constructor(changed) {
    this.changed = changed;
    this.review = setting("review") ?? "unreviewed";
    this.chips = REVIEWS.map(([value, text]) => h("button", {
      type: "button", data: { review: value }, "aria-pressed": String(value === this.review), text, on: { click: () => this.setReview(value) },
    }));
    this.search = h("input", { type: "search", id: "search", placeholder: "search  /", "aria-label": "Search names, classes and remarks (/)", maxlength: 80, on: { input: () => changed() } });
    this.sort = h("select", { id: "sort", "aria-label": "Sort", on: { change: () => { setting("sort", this.sort.value); changed(); } } },
      SORTS.map(([value, text]) => h("option", { value, text })));
    this.sort.value = setting("sort") ?? "arrived desc";
    if (!this.sort.value) this.sort.value = "arrived desc";
    this.vehicle = h("select", { id: "vehicle", "aria-label": "Vehicle", on: { change: () => changed() } }, h("option", { value: "", text: "all vehicles" }));
    this.confidence = h("select", { id: "confidence", "aria-label": "Detector confidence", on: { change: () => changed() } },
      [["", "any confidence"], ["0.5", "ATD ≥ 0.5"], ["1", "ATD ≥ 1.0"], ["1.5", "ATD ≥ 1.5"]].map(([value, text]) => h("option", { value, text })));
    this.completeOnly = h("input", { type: "checkbox", id: "whole", on: { change: () => changed() } });
    this.summary = h("span", { class: "number", "aria-live": "polite" });
    this.element = h("form", { class: "filters", role: "search", "aria-label": "Filter", on: { submit: (event) => event.preventDefault() } },
      h("div", { class: "chips", role: "group", "aria-label": "Verdict" }, this.chips),
      h("div", { class: "fields" }, this.search, this.sort, this.vehicle, this.confidence),
      h("div", { class: "sum" }, this.summary, labelled("", this.completeOnly, { class: "whole" })));
    this.completeOnly.after(" complete only");
  }

  setReview(value) {
    this.review = setting("review", value);
    for (const chip of this.chips) chip.setAttribute("aria-pressed", String(chip.dataset.review === value));
    this.changed();
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
    this.summary.textContent = `${matching} of ${state.total} shown`;
    if (vehicles.join() === [...this.vehicle.options].slice(1).map((one) => one.value).join()) return;
    const chosen = this.vehicle.value;
    fill(this.vehicle, h("option", { value: "", text: "all vehicles" }), vehicles.map((name) => h("option", { value: name, text: name })));
    this.vehicle.value = vehicles.includes(chosen) ? chosen : "";
  }
}
