// The object of a contact of training or of the calibrated watch, after the decision.

import { fill, h } from "../base/dom.js";
import { emit, listen, state } from "../base/state.js";
import { isCorrect } from "../shell/score_dialog.js";
import { t } from "../texts.js";

/** Result of a decision as text and CSS class. */
function result(one) {
  const correct = isCorrect(one);
  return correct === null ? [t("score.undecided"), ""] : correct ? [t("score.correct"), "good"] : [t("score.wrong"), "bad"];
}

export class KnownObject {
  constructor() {
    this.element = h("div", { class: "known hidden", role: "note" });
    this.line = h("span", { role: "status", id: "truth" });
    document.getElementById("result").append(this.line);
    listen("truth", (one) => { if (one.operator === state.session.user) this.#announce(one); });
  }

  /** Show the object of a contact, if the server has revealed it. */
  show({ contact, truth }) {
    this.element.classList.toggle("hidden", truth === null);
    if (truth === null) return;
    const [text, tone] = result({ verdict: contact.review === "disputed" ? "mine_like" : contact.review, is_mine_like: truth.is_mine_like });
    fill(this.element, h("p", {}, h("b", { text: `${t("score.known")}: ${truth.label}` }), " ", h("span", { class: tone, text })),
      truth.sealed ? h("p", { class: "muted", text: t("score.sealed") }) : null);
  }

  #announce(one) {
    const [text, tone] = result(one);
    this.line.className = tone;
    fill(this.line, h("button", { type: "button", text: one.name, on: { click: () => emit("select", { id: one.contact_id, name: one.name }) } }),
      ` ${t("score.line", { label: one.label, result: text })}`);
  }
}
