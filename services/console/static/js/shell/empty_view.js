// What the page shows before the first contact: the vehicles that it listens to, and since when.

import { since } from "../base/ages.js";
import { fill, h } from "../base/dom.js";
import { listen, state } from "../base/state.js";
import { t } from "../texts.js";

function listeningText(fleet) {
  const router = fleet.chain.find((link) => link.place === "router");
  if (!router) return "";
  if (router.state === "lost") return t("empty.not_listening");
  const names = fleet.chain.filter((link) => link.place === "vehicle" && link.name).map((link) => link.name);
  const values = { vehicles: names.join(", "), since: since(fleet.listening_since_utc_s) };
  return t(names.length ? "empty.listening_to" : "empty.listening", values);
}

export class EmptyView {
  constructor() {
    this.element = h("div", { class: "no-contacts hidden", role: "status" });
    for (const name of ["counts", "fleet"]) listen(name, () => this.render());
  }

  render() {
    const hidden = state.counts.total !== 0 || !state.fleet;
    this.element.classList.toggle("hidden", hidden);
    if (hidden) return;
    const text = `${t("empty.none")} ${listeningText(state.fleet)}`.trim();
    if (this.element.textContent !== text) fill(this.element, h("p", { text }));
  }
}
