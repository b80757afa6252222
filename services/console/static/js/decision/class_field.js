// The class of an object: a choice of the configured classes in groups, and free text.

import { h } from "../base/dom.js";
import { className } from "../base/format.js";
import { state } from "../base/state.js";
import { t } from "../texts.js";

export class ClassField {
  constructor(changed) {
    const option = (name) => h("option", { value: name, text: className(name) });
    const groups = state.info.classes.map(({ group, classes }) => (group ? h("optgroup", { label: group }, classes.map(option)) : classes.map(option)));
    this.choice = h("select", { id: "class-choice", "aria-label": t("class_field.title"), on: { change: () => { this.text.value = this.choice.value; changed(); } } },
      h("option", { value: "", text: t("class_field.none") }), groups);
    this.text = h("input", { id: "mlo-class", maxlength: 60, autocomplete: "off", "aria-label": t("class_field.text"), on: { input: () => { this.#choose(); changed(); } } });
    this.element = h("div", { class: "class-field", role: "group", "aria-label": t("class_field.title") },
      h("span", { text: t("class_field.title") }), h("div", { class: "two" }, this.choice, this.text));
  }

  get value() { return this.text.value; }

  set value(name) {
    if (this.text.value !== name) this.text.value = name;
    this.#choose();
  }

  #choose() {
    this.choice.value = this.text.value;
    if (this.choice.selectedIndex < 0) this.choice.value = "";
  }
}
