// The decision form: verdict, confidence, class and remark, and the state of the decision.

import { api } from "../base/api.js";
import { ClassField } from "./class_field.js";
import { fill, h, labelled, toast } from "../base/dom.js";
import { Drafts } from "./drafts.js";
import { percent, shoreState, symbol, time, vehicleState, verdict } from "../base/format.js";
import { OverruleForm } from "./overrule.js";
import { emit, state } from "../base/state.js";
import { t } from "../texts.js";

const VERDICTS = [["mine_like", "1"], ["not_mine_like", "2"], ["unsure", "3"]];

const SHORE_STEPS = ["waiting", "relay", "delivered"];
const VEHICLE_STEPS = ["waiting", "asked", "sent", "confirmed"];
const NOT_SENT = ["none", "withdrawn", "disputed"];

/** Progress bar of a delivery. */
function progress(name, steps, step, [text, tone]) {
  const index = steps.indexOf(step);
  const dots = steps.map((_, i) => {
    const failed = index < 0 && !NOT_SENT.includes(step) && i === 0;
    return h("i", { class: failed ? "failed" : i <= index ? (index === steps.length - 1 ? "end" : "done") : "" });
  });
  return h("li", {}, h("span", { text: name }), h("span", { class: "steps", "aria-hidden": "true" }, dots), h("span", { class: tone, text }));
}

/** Delivery of a decision to shore site and vehicle. */
export function deliveryProgress(delivery) {
  if (!delivery) return null;
  return [
    h("ul", { class: "progress", "aria-label": t("decision_form.delivery") },
      progress(t("decision_form.shore"), SHORE_STEPS, delivery.shore, shoreState(delivery)),
      progress(t("decision_form.vehicle"), VEHICLE_STEPS, delivery.vehicle, vehicleState(delivery))),
    delivery.reason ? h("p", { class: "bad", text: delivery.reason }) : null,
  ];
}

const confidenceText = (confidence) => (confidence === null ? null : t("decision_form.confidence_of", { value: percent(100 * confidence) }));

/** Verdict, class and confidence as text. */
export function decisionText(one) {
  return [verdict(one.verdict), one.mlo_class, confidenceText(one.confidence)].filter(Boolean).join(", ");
}

export class DecisionForm {
  /** `view`: the contact view, which displays the image. `status`: the line at the foot. `choose(verdict, hold)`: a button was used. */
  constructor(view, status, choose) {
    Object.assign(this, { view, status, onChoose: choose });
    this.drafts = new Drafts(state.session.user);
    this.detail = null;
    this.posts = new Map(); // contact → promise of its last request
    this.element = h("div", { class: "decision" });
    this.#build();
  }

  get isComment() { return state.info.side === "shore"; }
  get allowed() { return this.isComment ? state.session.may.advise : state.session.may.decide; }

  #build() {
    this.buttons = VERDICTS.map(([name, key]) => h("button", {
      type: "button", class: name, "aria-pressed": "false", data: { verdict: name }, on: { click: (event) => this.onChoose(name, event.shiftKey) },
    }, h("span", { text: symbol(name), "aria-hidden": "true" }), verdict(name), h("kbd", { text: key })));
    this.confidence = h("input", { type: "range", min: 0, max: 100, step: 5, id: "decision-confidence", "aria-label": t("decision_form.confidence_label"), on: { input: () => this.#updateDraft({ confidence: Number(this.confidence.value) / 100 }) } });
    this.confidenceText = h("output", { for: "decision-confidence", class: "number" });
    this.clearConfidence = h("button", { type: "button", class: "clear", text: "×", "aria-label": t("decision_form.clear_confidence"), title: t("decision_form.clear_confidence"), on: { click: () => this.#updateDraft({ confidence: null }) } });
    this.mloClass = new ClassField(() => this.#updateDraft());
    this.remark = h("textarea", { id: "remark", rows: 2, maxlength: 2000, on: { input: () => this.#updateDraft() } });
    this.send = h("button", { type: "button", class: "primary", id: "send", on: { click: () => this.onChoose(null, false) } });
    this.undoButton = h("button", { type: "button", id: "undo", text: t("decision_form.undo"), title: t("decision_form.undo_title"), on: { click: () => this.undo(this.#ownDecision()) } });
    this.current = h("div", { class: "now", role: "group", tabindex: 0, "aria-live": "polite", "aria-label": t("decision_form.state") });
    this.overrule = new OverruleForm((name, reason) => this.#overrule(name, reason));
    this.form = h("form", { on: { submit: (event) => event.preventDefault() } },
      h("fieldset", { id: "decide" },
        h("legend", { text: t(this.isComment ? "decision_form.comment" : "decision_form.decision") }),
        h("div", { class: "verdicts in-bar", role: "group", "aria-label": t("decision_form.verdict") }, this.buttons),
        h("div", { class: "confidence" }, h("label", {}, h("span", {}, t("decision_form.confidence"), " ", this.confidenceText), this.confidence), this.clearConfidence),
        this.mloClass.element,
        labelled(t("decision_form.remark"), this.remark),
        h("div", { class: "send in-bar" }, this.send, this.isComment ? null : this.undoButton)));
    this.element.append(this.current, this.form, this.overrule.element);
  }

  /** The standing decision of the user on the displayed contact. */
  #ownDecision() {
    const { decisions, standing } = this.detail;
    return decisions.find((one) => standing.includes(one.decision_id) && one.operator === state.session.user && !one.elsewhere) ?? null;
  }

  show(detail) {
    if (detail.contact.id !== this.detail?.contact.id) this.displayed_ms = performance.now();
    this.detail = detail;
    this.#render();
  }

  #render() {
    const { contact, decisions, standing } = this.detail;
    const draft = this.drafts.get(contact.id);
    for (const button of this.buttons) button.setAttribute("aria-pressed", String(button.dataset.verdict === draft.verdict));
    const unset = draft.confidence === null;
    const text = unset ? t("decision_form.not_given") : percent(100 * draft.confidence);
    this.confidence.value = unset ? 50 : Math.round(100 * draft.confidence);
    this.confidence.classList.toggle("unset", unset);
    this.confidence.setAttribute("aria-valuetext", text);
    this.confidenceText.textContent = text;
    this.clearConfidence.disabled = unset;
    this.mloClass.value = draft.mlo_class;
    if (this.remark.value !== draft.remark) this.remark.value = draft.remark;
    this.send.disabled = !this.allowed || draft.verdict === null || !contact.has_picture;
    fill(this.send, draft.verdict === null ? t("decision_form.choose") : [`${t("decision_form.send", { verdict: verdict(draft.verdict) })} `, h("kbd", { text: "Enter" })]);
    this.form.querySelector("fieldset").disabled = !this.allowed;
    this.undoButton.disabled = !this.allowed || !this.#ownDecision();
    this.#renderCurrent(decisions.find((one) => standing.includes(one.decision_id) && (contact.review !== "disputed" || one.verdict === "mine_like")));
    this.overrule.show(this.detail, this.allowed && !this.isComment);
  }

  #renderCurrent(counting) {
    const { contact, decisions } = this.detail;
    fill(this.current,
      h("p", {}, h("span", { class: `badge ${contact.review}` }, `${symbol(contact.review)} ${verdict(contact.review)}`),
        counting ? ` ${[counting.mlo_class, confidenceText(counting.confidence)].filter(Boolean).join(", ")}` : ""),
      counting
        ? h("p", { class: "number", text: t("decision_form.decided", { operator: counting.operator, time: time(counting.decided_utc_s), version: counting.version, layer: counting.layer ?? "raw" }) })
        : h("p", { class: "muted", text: t("decision_form.no_decision") }),
      this.allowed ? null : h("p", { class: "stale", text: this.#refusal() }),
      counting?.remark ? h("p", { class: "remark", text: `“${counting.remark}”` }) : null,
      decisions.length ? deliveryProgress(decisions[0].delivery) : null);
  }

  #refusal() { return t(this.isComment ? "decision_form.may_not_comment" : "decision_form.may_not_decide"); }

  #updateDraft(fields = {}) {
    this.drafts.change(this.detail.contact.id, { mlo_class: this.mloClass.value, remark: this.remark.value, ...fields });
    this.#render();
  }

  /** Select a verdict; Enter sends it. */
  select(name) {
    if (!this.detail) return;
    if (!this.allowed) {
      toast(this.#refusal(), { bad: true });
      return;
    }
    this.#updateDraft({ verdict: name });
  }

  /** Send the selected verdict, unless one is being sent; returns as `decide`. */
  submit() {
    const id = this.detail?.contact.id;
    const name = this.posts.has(id) ? null : this.detail && this.drafts.get(id).verdict;
    return name ? this.decide(name) : false;
  }

  /**
   * Send a decision on the drawn image, with class, confidence and remark of the draft.
   *
   * Returns whether it was sent and another contact can follow. The request continues.
   */
  decide(name) {
    if (!this.detail) return false;
    const { contact } = this.detail;
    if (!this.allowed) {
      toast(this.#refusal(), { bad: true });
      return false;
    }
    const image = this.view.drawn;
    if (!contact.has_picture || image?.id !== contact.id) {
      toast(t("decision_form.no_image", { name: contact.name }), { bad: true });
      return false;
    }
    this.drafts.change(contact.id, { verdict: name });
    const draft = this.drafts.get(contact.id);
    const body = { version: image.version, verdict: name, confidence: draft.confidence, mlo_class: draft.mlo_class.trim() || null, remark: draft.remark.trim() };
    const drawn = { revision: contact.revision, sha256: image.sha256, layer: image.layer, shown_s: Math.min(86400, (performance.now() - this.displayed_ms) / 1000) };
    this.#post(contact, () => (this.isComment ? api.advise(contact.id, body) : api.decide(contact.id, { ...body, ...drawn })), draft);
    if (this.form.contains(document.activeElement)) document.getElementById("queue").focus();
    this.#render();
    // A verdict that differs from the displayed one of another operator keeps the contact on the screen.
    return !this.isComment && !this.overrule.others.some((one) => one.verdict !== name);
  }

  /** Requests of one contact are sent in their order. The draft is removed, unless it was changed after it was sent. */
  #post(contact, request, draft = null) {
    const { id } = contact;
    const post = Promise.resolve(this.posts.get(id)).then(request).then((stored) => {
      if (JSON.stringify(this.drafts.get(id)) === JSON.stringify(draft)) this.drafts.remove(id);
      if (stored.decision) this.status.sent(stored.contact, stored.decision);
      else toast(t("decision_form.comment_sent", { name: contact.name }));
    }, (error) => this.status.failed(contact, error.message)).finally(() => {
      if (this.posts.get(id) === post) this.posts.delete(id);
      if (this.detail.contact.id === id) this.#render();
      emit("changed", { id });
    });
    this.posts.set(id, post);
  }

  /** Identifiers of contacts whose decision is being sent. */
  get sending() { return [...this.posts.keys()]; }

  /** Wait until all requests have been answered. */
  async settled() { await Promise.all(this.posts.values()); }

  #overrule(name, reason) {
    const { contact } = this.detail;
    const image = this.view.drawn;
    if (image?.id !== contact.id) {
      toast(t("decision_form.no_image", { name: contact.name }), { bad: true });
      return;
    }
    const body = { version: image.version, sha256: image.sha256, layer: image.layer, revision: contact.revision, verdict: name, confidence: null, mlo_class: null, remark: reason, overrules: true };
    this.#post(contact, () => api.decide(contact.id, body));
  }

  /** Withdraw an own decision on the displayed contact. */
  async undo(decision) {
    const { contact } = this.detail;
    const image = this.view.drawn;
    const { version = null, sha256 = null, layer = null } = image?.id === contact.id ? image : {};
    try {
      const undone = await api.undo(contact.id, { decision_id: decision.decision_id, version, sha256, layer });
      this.status.withdrawn(undone.contact, undone.decision);
    } catch (error) {
      toast(error.message, { bad: true });
    }
    emit("changed", { id: contact.id });
  }
}
