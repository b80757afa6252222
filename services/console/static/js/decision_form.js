// The decision form: verdict, confidence, class and remark; undo; conflicts with other operators.

import { api } from "./api.js";
import { fill, h, labelled, showDialog, toast } from "./dom.js";
import { percent, shoreState, symbol, time, vehicleState, verdict } from "./format.js";
import { emit, state } from "./state.js";

const VERDICTS = [["mine_like", "1"], ["not_mine_like", "2"], ["unsure", "3"]];

const SHORE_STEPS = ["waiting", "relay", "delivered"];
const VEHICLE_STEPS = ["waiting", "asked", "sent", "confirmed"];

/** Progress bar of a delivery. */
function progress(name, steps, step, [text, tone]) {
  const index = steps.indexOf(step);
  const dots = steps.map((_, i) => {
    const failed = index < 0 && step !== "none" && i === 0;
    return h("i", { class: failed ? "failed" : i <= index ? (index === steps.length - 1 ? "end" : "done") : "" });
  });
  return h("li", {}, h("span", { text: name }), h("span", { class: "steps", "aria-hidden": "true" }, dots), h("span", { class: tone, text }));
}

/** Delivery of a decision to shore site and vehicle. */
export function deliveryProgress(delivery) {
  if (!delivery) return null;
  return [
    h("ul", { class: "progress", "aria-label": "Delivery" },
      progress("shore site", SHORE_STEPS, delivery.shore, shoreState(delivery)),
      progress("vehicle", VEHICLE_STEPS, delivery.vehicle, vehicleState(delivery))),
    delivery.reason ? h("p", { class: "bad", text: delivery.reason }) : null,
  ];
}

/** Verdict, class and confidence as text. */
export function decisionText(one) {
  return [verdict(one.verdict), one.mlo_class, one.confidence === null ? null : `${percent(100 * one.confidence)} confidence`].filter(Boolean).join(", ");
}

export class DecisionForm {
  /** `view`: the contact view, which displays the image. */
  constructor(view) {
    this.view = view;
    this.drafts = new Map(); // contact → unsent input, kept while other contacts are displayed
    this.detail = null;
    this.sending = false;
    this.element = h("div", { class: "decision" });
    this.#build();
  }

  get isComment() { return state.info.side === "shore"; }
  get allowed() { return this.isComment ? state.session.may.advise : state.session.may.decide; }

  #build() {
    this.buttons = VERDICTS.map(([name, key]) => h("button", {
      type: "button", class: name, "aria-pressed": "false", data: { verdict: name }, on: { click: () => this.choose(name) },
    }, h("span", { text: symbol(name), "aria-hidden": "true" }), verdict(name), h("kbd", { text: key })));
    this.confidence = h("input", { type: "range", min: 0, max: 100, step: 5, id: "decision-confidence", "aria-label": "confidence (g)", on: { input: () => this.#updateDraft() } });
    this.confidenceText = h("output", { for: "decision-confidence", class: "number" });
    this.mloClass = h("input", { id: "mlo-class", list: "classes", maxlength: 60, autocomplete: "off", on: { input: () => this.#updateDraft() } });
    this.remark = h("textarea", { id: "remark", rows: 2, maxlength: 2000, on: { input: () => this.#updateDraft() } });
    this.send = h("button", { type: "submit", class: "primary", id: "send" });
    this.undoButton = h("button", { type: "button", id: "undo", on: { click: () => this.undo() } }, "undo ", h("kbd", { text: "u" }));
    this.current = h("div", { class: "now", "aria-live": "polite" });
    this.form = h("form", { on: { submit: (event) => { event.preventDefault(); this.submit(); } } },
      h("fieldset", { id: "decide" },
        h("legend", { text: this.isComment ? "Your comment for the vessel" : "Your decision" }),
        h("div", { class: "verdicts in-bar", role: "group", "aria-label": "Verdict" }, this.buttons),
        h("label", {}, h("span", {}, "confidence: ", this.confidenceText), this.confidence),
        labelled("class", this.mloClass), h("datalist", { id: "classes" }, state.info.classes.map((name) => h("option", { value: name }))),
        labelled("remark", this.remark),
        h("div", { class: "send in-bar" }, this.send, this.isComment ? null : this.undoButton)));
    this.element.append(this.current, this.form);
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
    this.confidence.value = draft.confidence === null ? 50 : Math.round(100 * draft.confidence);
    this.confidence.setAttribute("aria-valuetext", draft.confidence === null ? "not stated" : `${this.confidence.value} per cent`);
    this.confidenceText.textContent = draft.confidence === null ? "not stated" : percent(100 * draft.confidence);
    if (this.mloClass.value !== draft.mlo_class) this.mloClass.value = draft.mlo_class;
    if (this.remark.value !== draft.remark) this.remark.value = draft.remark;
    const ready = this.allowed && draft.verdict !== null && !this.sending && contact.has_picture;
    this.send.disabled = !ready;
    fill(this.send, draft.verdict === null ? "choose 1, 2 or 3" : `send “${verdict(draft.verdict)}” `, draft.verdict === null ? null : h("kbd", { text: "Enter" }));
    this.form.querySelector("fieldset").disabled = !this.allowed;
    const [last] = decisions.filter((one) => !one.undone && one.undoes === null);
    this.undoButton.disabled = !this.allowed || !last || last.elsewhere;
    this.#renderCurrent(last, draft);
  }

  #renderCurrent(last, draft) {
    const { contact, decisions } = this.detail;
    const changed = draft.verdict !== null && draft.revision !== contact.revision;
    fill(this.current,
      h("p", {}, h("span", { class: `badge ${contact.review}` }, `${symbol(contact.review)} ${verdict(contact.review)}`),
        last ? ` ${[last.mlo_class, last.confidence === null ? null : `${percent(100 * last.confidence)} confidence`].filter(Boolean).join(", ")}` : ""),
      last ? h("p", { class: "number", text: `${last.operator}, ${time(last.decided_utc_s)}, on version ${last.version} (${last.layer ?? "raw"})` }) : h("p", { class: "muted", text: "No decision yet." }),
      last?.remark ? h("p", { class: "remark", text: `“${last.remark}”` }) : null,
      decisions.length ? deliveryProgress(decisions[0].delivery) : null,
      changed ? h("p", { class: "stale", text: "Another decision was made since you chose. You will be asked before yours replaces it." }) : null,
      this.allowed ? null : h("p", { class: "stale", text: this.isComment ? "Your role may not comment." : "Your role may not decide." }));
  }

  #updateDraft() {
    const draft = this.#draft();
    if (document.activeElement === this.confidence) draft.confidence = Number(this.confidence.value) / 100;
    draft.mlo_class = this.mloClass.value;
    draft.remark = this.remark.value;
    this.#render();
  }

  /** Choose a verdict; the second key, Enter, sends it. */
  choose(name) {
    if (!this.detail) return;
    if (!this.allowed) {
      toast(this.isComment ? "Your role may not comment." : "Your role may not decide.", { bad: true });
      return;
    }
    const draft = this.#draft();
    draft.verdict = name;
    // A decision of another operator after this moment is a conflict.
    draft.revision = this.detail.contact.revision;
    this.#render();
    if (!this.send.disabled) this.send.focus();
  }

  #body(draft, revision) {
    const { version, sha256 } = this.view.shown;
    const body = { version, verdict: draft.verdict, confidence: draft.confidence, mlo_class: draft.mlo_class.trim() || null, remark: draft.remark.trim() };
    return this.isComment ? body : { ...body, revision, sha256, layer: this.view.layer };
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
      if (this.isComment) await api.advise(id, this.#body(draft, revision));
      else await api.decide(id, this.#body(draft, revision));
      this.drafts.delete(id);
      toast(this.isComment ? `${name}: comment sent` : `${name}: ${verdict(draft.verdict)}. Undo with u.`);
      this.element.closest(".review")?.querySelector("#queue")?.focus();
      emit("changed", { id });
    } catch (error) {
      if (error.code === "conflict") await this.#resolveConflict(draft, error.body);
      else toast(error.message, { bad: true });
    } finally {
      this.sending = false;
      this.#render();
    }
  }

  /** Show both decisions side by side. Only an explicit choice replaces the other one. */
  async #resolveConflict(draft, { contact, decision }) {
    emit("changed", { id: contact.id });
    const theirs = decision === null
      ? [h("h3", { text: "Changed" }), h("p", { text: "A previous decision was undone." })]
      : [h("h3", { text: decision.operator }), h("p", {}, h("span", { class: `badge ${decision.verdict}` }, `${symbol(decision.verdict)} ${verdict(decision.verdict)}`)),
        h("p", { text: decisionText(decision) }), h("p", { class: "number", text: time(decision.decided_utc_s) }), decision.remark ? h("p", { text: `“${decision.remark}”` }) : null];
    const mine = [h("h3", { text: "You" }), h("p", {}, h("span", { class: `badge ${draft.verdict}` }, `${symbol(draft.verdict)} ${verdict(draft.verdict)}`)),
      h("p", { text: decisionText({ ...draft, mlo_class: draft.mlo_class || null }) }), draft.remark ? h("p", { text: `“${draft.remark}”` }) : null];
    const choice = await showDialog(`${contact.name}: another operator has decided`, [
      h("p", { text: "Your decision has not been sent." }), h("div", { class: "versus" }, h("div", {}, theirs), h("div", {}, mine)),
    ], [
      { label: "Keep theirs", value: "theirs", primary: true },
      { label: `Replace it with “${verdict(draft.verdict)}”`, value: "mine" },
      { label: "Decide later", value: "later" },
    ]);
    if (choice === "theirs") this.drafts.delete(contact.id);
    if (choice === "mine" && this.detail.contact.id === contact.id) await this.#post(draft, contact.revision);
    else if (choice === "mine") toast("Another contact is displayed now; nothing was sent.", { bad: true });
  }

  async undo() {
    const [last] = this.detail?.decisions.filter((one) => !one.undone && one.undoes === null) ?? [];
    if (!last || this.undoButton.disabled) {
      toast("There is no decision of this console to undo.", { bad: true });
      return;
    }
    try {
      await api.undo(this.detail.contact.id, { revision: this.detail.contact.revision, decision_id: last.decision_id });
      toast(`${this.detail.contact.name}: “${verdict(last.verdict)}” is undone; shore site and vehicle are notified.`);
    } catch (error) {
      toast(error.message, { bad: true });
    }
    emit("changed", { id: this.detail.contact.id });
  }
}
