// The decision: chosen by one key, sent by a second, undone by a third; a conflict is shown, never overwritten.

import { api } from "./api.js";
import { ask, fill, h, labelled, toast } from "./dom.js";
import { percent, shoreStep, symbol, time, vehicleStep, verdict } from "./format.js";
import { state, tell } from "./state.js";

const VERDICTS = [["mine_like", "1"], ["not_mine_like", "2"], ["unsure", "3"]];

const SHORE_STEPS = ["waiting", "relay", "delivered"];
const VEHICLE_STEPS = ["waiting", "asked", "sent", "confirmed"];

function rail(name, steps, at, [words, tone]) {
  const index = steps.indexOf(at);
  const dots = steps.map((_, i) => {
    const failed = index < 0 && at !== "none" && i === 0;
    return h("i", { class: failed ? "failed" : i <= index ? (index === steps.length - 1 ? "end" : "done") : "" });
  });
  return h("li", {}, h("span", { text: name }), h("span", { class: "steps", "aria-hidden": "true" }, dots), h("span", { class: tone, text: words }));
}

/** How far a decision has come, to shore and vehicle. */
export function deliveryRails(delivery) {
  if (!delivery) return null;
  return [
    h("ul", { class: "progress", "aria-label": "Delivery" },
      rail("shore", SHORE_STEPS, delivery.shore, shoreStep(delivery)),
      rail("vehicle", VEHICLE_STEPS, delivery.vehicle, vehicleStep(delivery))),
    delivery.reason ? h("p", { class: "bad", text: delivery.reason }) : null,
  ];
}

export function decisionWords(one) {
  return [verdict(one.verdict), one.mlo_class, one.confidence === null ? null : `${percent(100 * one.confidence)} sure`].filter(Boolean).join(", ");
}

export class DecisionForm {
  /** `view` is the contact view, which knows what picture is on the screen. */
  constructor(view) {
    this.view = view;
    this.drafts = new Map(); // contact → what has been chosen and typed; nothing typed is lost by looking elsewhere
    this.detail = null;
    this.sending = false;
    this.element = h("div", { class: "decision" });
    this.#build();
  }

  get advises() { return state.info.side === "shore"; }
  get allowed() { return this.advises ? state.session.may.advise : state.session.may.decide; }

  #build() {
    this.buttons = VERDICTS.map(([name, key]) => h("button", {
      type: "button", class: name, "aria-pressed": "false", data: { verdict: name }, on: { click: () => this.choose(name) },
    }, h("span", { text: symbol(name), "aria-hidden": "true" }), verdict(name), h("kbd", { text: key })));
    this.sure = h("input", { type: "range", min: 0, max: 100, step: 5, id: "sure", "aria-label": "how sure (g)", on: { input: () => this.#typed() } });
    this.sureWords = h("output", { for: "sure", class: "number" });
    this.kind = h("input", { id: "mlo-class", list: "classes", maxlength: 60, autocomplete: "off", on: { input: () => this.#typed() } });
    this.remark = h("textarea", { id: "remark", rows: 2, maxlength: 2000, on: { input: () => this.#typed() } });
    this.send = h("button", { type: "submit", class: "primary", id: "send" });
    this.undoButton = h("button", { type: "button", id: "undo", on: { click: () => this.undo() } }, "undo ", h("kbd", { text: "u" }));
    this.now = h("div", { class: "now", "aria-live": "polite" });
    this.form = h("form", { on: { submit: (event) => { event.preventDefault(); this.submit(); } } },
      h("fieldset", { id: "decide" },
        h("legend", { text: this.advises ? "Your advice to the vessel" : "Your decision" }),
        h("div", { class: "verdicts", role: "group", "aria-label": "Verdict" }, this.buttons),
        h("label", {}, h("span", {}, "how sure: ", this.sureWords), this.sure),
        labelled("class", this.kind), h("datalist", { id: "classes" }, state.info.classes.map((name) => h("option", { value: name }))),
        labelled("remark", this.remark),
        h("div", { class: "send" }, this.send, this.advises ? null : this.undoButton)));
    this.element.append(this.now, this.form);
  }

  #draft() {
    const { id } = this.detail.contact;
    if (!this.drafts.has(id)) this.drafts.set(id, { verdict: null, confidence: null, mlo_class: "", remark: "", revision: null });
    return this.drafts.get(id);
  }

  show(detail) {
    this.detail = detail;
    this.#render();
  }

  #render() {
    const draft = this.#draft();
    const { contact, decisions } = this.detail;
    for (const button of this.buttons) button.setAttribute("aria-pressed", String(button.dataset.verdict === draft.verdict));
    this.sure.value = draft.confidence === null ? 50 : Math.round(100 * draft.confidence);
    this.sure.setAttribute("aria-valuetext", draft.confidence === null ? "not said" : `${this.sure.value} per cent`);
    this.sureWords.textContent = draft.confidence === null ? "not said" : percent(100 * draft.confidence);
    if (this.kind.value !== draft.mlo_class) this.kind.value = draft.mlo_class;
    if (this.remark.value !== draft.remark) this.remark.value = draft.remark;
    const ready = this.allowed && draft.verdict !== null && !this.sending && contact.has_picture;
    this.send.disabled = !ready;
    fill(this.send, draft.verdict === null ? "choose 1, 2 or 3" : `send “${verdict(draft.verdict)}” `, draft.verdict === null ? null : h("kbd", { text: "Enter" }));
    this.form.querySelector("fieldset").disabled = !this.allowed;
    const [last] = decisions.filter((one) => !one.undone && one.undoes === null);
    this.undoButton.disabled = !this.allowed || !last || last.elsewhere;
    this.#current(last, draft);
  }

  #current(last, draft) {
    const { contact, decisions } = this.detail;
    const changed = draft.verdict !== null && draft.revision !== contact.revision;
    fill(this.now,
      h("p", {}, h("span", { class: `badge ${contact.review}` }, `${symbol(contact.review)} ${verdict(contact.review)}`),
        last ? ` ${[last.mlo_class, last.confidence === null ? null : `${percent(100 * last.confidence)} sure`].filter(Boolean).join(", ")}` : ""),
      last ? h("p", { class: "number", text: `${last.operator}, ${time(last.decided_utc_s)}, on version ${last.version} (${last.layer ?? "raw"})` }) : h("p", { class: "muted", text: "Nobody has decided." }),
      last?.remark ? h("p", { class: "remark", text: `“${last.remark}”` }) : null,
      decisions.length ? deliveryRails(decisions[0].delivery) : null,
      changed ? h("p", { class: "stale", text: "This contact has changed since you chose. You will be asked before yours replaces it." }) : null,
      this.allowed ? null : h("p", { class: "stale", text: this.advises ? "Your role may not advise." : "Your role may look, not decide." }));
  }

  #typed() {
    const draft = this.#draft();
    if (document.activeElement === this.sure) draft.confidence = Number(this.sure.value) / 100;
    draft.mlo_class = this.kind.value;
    draft.remark = this.remark.value;
    this.#render();
  }

  /** Choose a verdict; the second key, Enter, sends it. */
  choose(name) {
    if (!this.detail) return;
    if (!this.allowed) {
      toast(this.advises ? "Your role may not advise." : "Your role may look, not decide.", { bad: true });
      return;
    }
    const draft = this.#draft();
    draft.verdict = name;
    // What was decided when the operator chose: another's decision after this moment is a conflict.
    draft.revision = this.detail.contact.revision;
    this.#render();
    if (!this.send.disabled) this.send.focus();
  }

  #body(draft, revision) {
    const { version, sha256 } = this.view.shown;
    const said = { version, verdict: draft.verdict, confidence: draft.confidence, mlo_class: draft.mlo_class.trim() || null, remark: draft.remark.trim() };
    return this.advises ? said : { ...said, revision, sha256, layer: this.view.layer };
  }

  async submit() {
    const draft = this.#draft();
    if (this.send.disabled || !this.view.shown) return;
    await this.#post(draft, draft.revision);
  }

  async #post(draft, revision) {
    const { id, name } = this.detail.contact;
    this.sending = true;
    this.#render();
    try {
      if (this.advises) await api.advise(id, this.#body(draft, revision));
      else await api.decide(id, this.#body(draft, revision));
      this.drafts.delete(id);
      toast(this.advises ? `${name}: advice given` : `${name}: ${verdict(draft.verdict)}. Undo with u.`);
      this.element.closest(".review")?.querySelector("#queue")?.focus();
      tell("changed", { id });
    } catch (error) {
      if (error.code === "conflict") await this.#conflict(draft, error.body);
      else toast(error.message, { bad: true });
    } finally {
      this.sending = false;
      this.#render();
    }
  }

  /** Show both decisions side by side; only a deliberate choice replaces the other's. */
  async #conflict(draft, { contact, decision }) {
    tell("changed", { id: contact.id });
    const theirs = decision === null
      ? [h("h3", { text: "Meanwhile" }), h("p", { text: "An earlier decision was undone." })]
      : [h("h3", { text: decision.operator }), h("p", {}, h("span", { class: `badge ${decision.verdict}` }, `${symbol(decision.verdict)} ${verdict(decision.verdict)}`)),
        h("p", { text: decisionWords(decision) }), h("p", { class: "number", text: time(decision.decided_utc_s) }), decision.remark ? h("p", { text: `“${decision.remark}”` }) : null];
    const mine = [h("h3", { text: "You" }), h("p", {}, h("span", { class: `badge ${draft.verdict}` }, `${symbol(draft.verdict)} ${verdict(draft.verdict)}`)),
      h("p", { text: decisionWords({ ...draft, mlo_class: draft.mlo_class || null }) }), draft.remark ? h("p", { text: `“${draft.remark}”` }) : null];
    const answer = await ask(`${contact.name}: somebody was faster`, [
      h("p", { text: "Nothing of yours has been sent." }), h("div", { class: "versus" }, h("div", {}, theirs), h("div", {}, mine)),
    ], [
      { label: "Keep theirs", value: "theirs", primary: true },
      { label: `Replace it by “${verdict(draft.verdict)}”`, value: "mine" },
      { label: "Decide later", value: "later" },
    ]);
    if (answer === "theirs") this.drafts.delete(contact.id);
    if (answer === "mine" && this.detail.contact.id === contact.id) await this.#post(draft, contact.revision);
    else if (answer === "mine") toast("Another contact is shown now; nothing was sent.", { bad: true });
  }

  async undo() {
    const [last] = this.detail?.decisions.filter((one) => !one.undone && one.undoes === null) ?? [];
    if (!last || this.undoButton.disabled) {
      toast("There is nothing of this console to undo here.", { bad: true });
      return;
    }
    try {
      await api.undo(this.detail.contact.id, { revision: this.detail.contact.revision, decision_id: last.decision_id });
      toast(`${this.detail.contact.name}: “${verdict(last.verdict)}” is undone; shore and vehicle are told.`);
    } catch (error) {
      toast(error.message, { bad: true });
    }
    tell("changed", { id: this.detail.contact.id });
  }
}
