// Texts of the page in the language of the user. `texts/en.js` is the catalogue; other languages have the same names.

import en from "./texts/en.js";

export const LANGUAGES = { en: "English", de: "Deutsch", fr: "Français" };

let texts = en;
let rules = new Intl.PluralRules("en");

/** Load a language before the page is drawn; an unknown one is English. */
export async function loadLanguage(language) {
  const known = Object.hasOwn(LANGUAGES, language ?? "") ? language : "en";
  texts = known === "en" ? en : (await import(`./texts/${known}.js`)).default;
  rules = new Intl.PluralRules(known);
  document.documentElement.lang = known;
}

/**
 * Text of a name such as "decision.send", with `{name}` replaced by values.
 *
 * A text of two forms is `{ one, other }`; the value `count` selects the form.
 */
export function t(name, values = {}) {
  const found = texts[name] ?? en[name];
  if (found === undefined) throw new Error(`no text ${name}`);
  const text = typeof found === "string" ? found : found[rules.select(values.count)] ?? found.other;
  return text.replace(/\{(\w+)\}/g, (_, key) => String(values[key]));
}

/** Replace the texts of elements with the attribute `data-text`, the name of a text. */
export function translate(root) {
  for (const element of root.querySelectorAll("[data-text]")) element.textContent = t(element.dataset.text);
}
