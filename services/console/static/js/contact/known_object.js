// The object of a contact of training or of the calibrated watch, after the decision.

import { fill, h } from "../base/dom.js";
import { emit, listen, state } from "../base/state.js";
import { verdictResult } from "../shell/score_dialog.js";
import { t } from "../texts.js";

export class KnownObject {
  constructor() {
    this.element = h("div", { class: "known hidden", role: "note" });
    this.line = h("span", { role: "status", id: "truth" });
    document.getElementById("result").append(this.line);
    this.waiting = new Set(); // contacts with a verdict of the user whose object is not yet shown
    listen("contact", ({ contact }) => this.#update(contact));
  }

  /** Show the object of a contact, if the server has revealed it. */
  show({ contact, truth }) {
    this.element.classList.toggle("hidden", truth === null);
    if (truth === null) return;
    const [text, tone] = verdictResult({ verdict: contact.review === "disputed" ? "mine_like" : contact.review, is_mine_like: truth.is_mine_like });
    fill(this.element, h("p", {}, h("b", { text: `${t("score.known")}: ${truth.label}` }), " ", h("span", { class: tone, text })),
      truth.sealed ? h("p", { class: "muted", text: t("score.sealed") }) : null);
  }

  /** Announce the object of a contact when the server reveals it, some seconds after the verdict of the user. */
  #update({ id, name, review, decided_by, known }) {
    const own = state.info.known_objects && decided_by === state.session.user;
    if (own && !known) this.waiting.add(id);
    else if (this.waiting.delete(id) && own) {
      const [text, tone] = verdictResult({ verdict: review === "disputed" ? "mine_like" : review, is_mine_like: known.is_mine_like });
      this.line.className = tone;
      fill(this.line, h("button", { type: "button", text: name, on: { click: () => emit("select", { id, name }) } }), ` ${t("score.line", { label: known.label, result: text })}`);
    }
  }
}
