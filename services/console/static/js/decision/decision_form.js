// The decision form: verdict, confidence, class and remark, and the state of the decision.

import { api } from "../base/api.js";
import { ClassField } from "./class_field.js";
import { fill, h, labelled, showDialog, toast } from "../base/dom.js";
import { Drafts } from "./drafts.js";
import { VERDICTS, layerName, percent, shoreState, symbol, time, vehicleState, verdict } from "../base/format.js";
import { OverruleForm } from "./overrule.js";
import { state } from "../base/state.js";
import { t } from "../texts.js";
import { VerdictGuard } from "./verdict_guard.js";

/** Chips of the confidence, and the values that are stored. */
const CONFIDENCES = { low: 0.25, medium: 0.5, high: 0.9 };
const MARKS = { good: "✓", bad: "✗" };

/** Delivery to a place in one sign, with its text for screen readers and as a tooltip; nothing for a place without delivery. */
function deliveryMark(place, step, state) {
  const [text, tone] = state;
  if (step === "none") return null;
  const sign = MARKS[tone] ?? (["withdrawn", "disputed"].includes(step) ? "–" : "…");
  return [` · ${place} `, h("span", { class: tone, role: "img", title: text, "aria-label": text, text: sign })];
}

const confidenceText = (confidence) => (confidence === null ? null : t("decision_form.confidence_of", { value: percent(100 * confidence) }));

/** Verdict, class and confidence as text. */
export function decisionText(/** @type {Decision} */ one) {
  return [verdict(one.verdict), one.mlo_class, confidenceText(one.confidence)].filter(Boolean).join(", ");
}

export class DecisionForm {
  /** `view`: the contact view, which displays the image. `status`: the line at the foot. `choose(verdict)`: a button was used. */
  constructor(view, status, choose) {
    this.view = view;
    this.status = status;
    this.onChoose = choose;
    this.drafts = new Drafts(state.session.user);
    this.detail = null;
    this.posts = new Map(); // contact → promise of its last request
    this.element = h("div", { class: "decision" });
    this.#build();
    this.guard = new VerdictGuard(() => view.drawn?.id === this.detail?.contact.id && view.canvases[0].checkVisibility(), (ready) => { this.element.dataset.ready = String(ready); });
  }

  get isComment() { return state.info.side === "shore"; }
  get allowed() { return this.isComment ? state.session.may.comment : state.session.may.decide; }

  #build() {
    this.buttons = VERDICTS.map((name, index) => h("button", {
      type: "button", class: name, "aria-pressed": "false", data: { verdict: name }, on: { click: () => this.onChoose(name) },
    }, h("span", { text: symbol(name), "aria-hidden": "true" }), verdict(name), h("kbd", { text: String(index + 1) })));
    this.chips = Object.entries(CONFIDENCES).map(([name, value]) => h("button", {
      type: "button", data: { confidence: value }, title: percent(100 * value), text: t(`decision_form.confidence.${name}`),
      on: { click: () => this.#updateDraft({ confidence: this.drafts.get(this.detail.contact.id).confidence === value ? null : value }) },
    }));
    this.mloClass = new ClassField(() => this.#updateDraft());
    this.remark = h("textarea", { id: "remark", rows: 2, maxlength: 2000, on: { input: () => this.#updateDraft() } });
    this.note = h("p", { class: "stale" }); // state of the draft, or why the user cannot decide
    this.lines = h("ul", { class: "standing" });
    this.more = h("details", {}, h("summary", { text: t("decision_form.details") }), h("div", {}));
    this.current = h("div", { class: "now", role: "group", "aria-live": "polite", "aria-label": t("decision_form.state") }, this.lines, this.more);
    this.overrule = new OverruleForm((name, reason) => this.#overrule(name, reason));
    this.form = h("form", { on: { submit: (event) => event.preventDefault() } },
      h("fieldset", { id: "decide" },
        h("legend", { text: t(this.isComment ? "decision_form.comment" : "decision_form.decision") }),
        h("div", { class: "verdicts in-bar", role: "group", "aria-label": t("decision_form.verdict") }, this.buttons),
        h("div", { class: "confidence", role: "group", "aria-label": t("decision_form.confidence") }, h("span", { text: t("decision_form.confidence") }), this.chips),
        this.mloClass.element,
        labelled(t("decision_form.remark"), this.remark)));
    this.element.append(this.form, this.note, this.current, this.overrule.element);
  }

  show(/** @type {ContactDetail} */ detail) {
    // The remarks of a dispute are in sight.
    if (detail.contact.id !== this.detail?.contact.id) this.more.open = detail.contact.review === "disputed";
    this.detail = detail;
    this.guard.show(detail.contact.id);
    this.#render();
  }

  #render() {
    const { contact } = this.detail;
    const draft = this.drafts.get(contact.id);
    for (const button of this.buttons) button.setAttribute("aria-pressed", String(button.dataset.verdict === draft.verdict));
    for (const chip of this.chips) chip.setAttribute("aria-pressed", String(Number(chip.dataset.confidence) === draft.confidence));
    this.mloClass.value = draft.mlo_class;
    if (this.remark.value !== draft.remark) this.remark.value = draft.remark;
    this.form.querySelector("fieldset").disabled = !this.allowed;
    this.note.textContent = !this.allowed ? this.#refusal() : this.drafts.restored.has(contact.id) ? t("decision_form.draft", { verdict: draft.verdict ? `${symbol(draft.verdict)} ${verdict(draft.verdict)}` : "" }) : "";
    this.#renderCurrent();
    this.overrule.show(this.detail, this.allowed && !this.isComment);
  }

  /** The state of the contact: a line for the standing decision of each operator, with its delivery; details on demand. */
  #renderCurrent() {
    const { contact, decisions, standing } = this.detail;
    const all = decisions.filter((one) => standing.includes(one.decision_id));
    const counting = all.find((one) => contact.review !== "disputed" || one.verdict === "mine_like");
    fill(this.lines, contact.review === "disputed" ? h("li", {}, h("span", { class: "badge disputed", text: `${symbol("disputed")} ${verdict("disputed")}` })) : null,
      all.map((one) => h("li", { class: one === counting ? "counts" : "" },
        h("span", { class: `badge ${one.verdict}`, title: verdict(one.verdict), "aria-label": verdict(one.verdict), role: "img", text: symbol(one.verdict) }), ` ${one.operator} ${time(one.decided_utc_s).slice(0, 5)}`,
        one.delivery ? [deliveryMark(t("decision_form.shore"), one.delivery.shore, shoreState(one.delivery)), deliveryMark(t("chain.place.vehicle"), one.delivery.vehicle, vehicleState(one.delivery))] : null)),
      all.length ? null : h("li", { class: "muted", text: t("decision_form.no_decision") }));
    this.more.classList.toggle("hidden", !all.length);
    fill(/** @type {HTMLElement} */ (this.more.lastElementChild), all.map((one) => [
      h("p", {}, h("b", { text: decisionText(one) }), ` ${t("decision_form.decided", { operator: one.operator, time: time(one.decided_utc_s), version: one.version, layer: layerName(null, one.layer ?? "raw") })}`),
      one.remark ? h("p", { class: "remark", text: `“${one.remark}”` }) : null,
      one.delivery ? h("p", { class: "muted", text: `${t("decision_form.shore")}: ${shoreState(one.delivery)[0]} · ${t("chain.place.vehicle")}: ${vehicleState(one.delivery)[0]}` }) : null,
      one.delivery?.reason ? h("p", { class: "bad", text: one.delivery.reason }) : null,
    ]));
  }

  #refusal() { return t(this.isComment ? "decision_form.may_not_comment" : "decision_form.may_not_decide"); }

  #updateDraft(fields = {}) {
    this.drafts.change(this.detail.contact, { mlo_class: this.mloClass.value, remark: this.remark.value, ...fields });
    this.#render();
  }

  /** Report visibly that a verdict was ignored. */
  flash() {
    this.view.stage.animate({ outline: ["6px solid orange", "6px solid transparent"], outlineOffset: ["-6px", "-6px"] }, 600);
    toast(t("decision_form.early"));
  }

  /**
   * Send a decision on the drawn image, with class, confidence and remark of the draft.
   *
   * Resolves to whether it was sent and another contact can follow. The request continues.
   */
  async decide(name) {
    if (!this.detail) return false;
    const { contact } = this.detail;
    if (!this.allowed) {
      toast(this.#refusal(), { bad: true });
      return false;
    }
    const image = this.view.drawn;
    if (!contact.has_image || image?.id !== contact.id) {
      toast(t("decision_form.no_image", { name: contact.name }), { bad: true });
      return false;
    }
    if (!this.guard.ready) {
      this.flash();
      return false;
    }
    const drawn = { revision: contact.revision, sha256: image.sha256, layer: image.layer, shown_s: this.guard.shown_s };
    const { isMany } = this.guard;
    if (isMany && !await this.#confirm(contact, name)) return false;
    this.guard.sent(isMany);
    this.drafts.change(contact, { verdict: name });
    const draft = this.drafts.get(contact.id);
    const body = { version: image.version, verdict: name, confidence: draft.confidence, mlo_class: draft.mlo_class.trim() || null, remark: draft.remark.trim() };
    this.#post(contact, () => (this.isComment ? api.comment(contact.id, body) : api.decide(contact.id, { ...body, ...drawn })), draft);
    if (this.form.contains(document.activeElement)) document.getElementById("queue").focus();
    this.#render();
    // A verdict that differs from the displayed one of another operator keeps the contact on the screen.
    return !this.isComment && !this.overrule.others.some((one) => one.verdict !== name);
  }

  /** Ask whether a verdict that follows others quickly is intended. */
  #confirm(contact, name) {
    const text = `${symbol(name)} ${verdict(name)}`;
    return showDialog(t("decision_form.many"), h("p", { text: t("decision_form.many_text", { name: contact.name, verdict: text }) }), [
      { label: t("decision_form.send", { verdict: text }), value: true, primary: true }, { label: t("decision_form.do_not_send"), value: null }]);
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
  }
}
