// Texts of the page in the language of the user. `texts/en.js` is the catalogue; other languages have the same names.

import en from "./texts/en.js";

export const LANGUAGES = { en: "English", de: "Deutsch", fr: "Français" };

let texts = en;
let language = "en";
let rules = new Intl.PluralRules(language);
const formats = new Map(); // language and digits → Intl.NumberFormat

/** Load a language before the page is drawn; an unknown one is English. */
export async function loadLanguage(name) {
  language = Object.hasOwn(LANGUAGES, name ?? "") ? name : "en";
  texts = language === "en" ? en : (await import(`./texts/${language}.js`)).default;
  rules = new Intl.PluralRules(language);
  document.documentElement.lang = language;
}

/**
 * A number with the separators of the language.
 *
 * @param {number} value
 * @param {number} [digits] Digits after the decimal separator.
 * @param {object} [options] Further options of Intl.NumberFormat.
 */
export function number(value, digits = 0, options = {}) {
  const key = `${language} ${digits} ${JSON.stringify(options)}`;
  if (!formats.has(key)) formats.set(key, new Intl.NumberFormat(language, { minimumFractionDigits: digits, maximumFractionDigits: digits, ...options }));
  return formats.get(key).format(value);
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
  return text.replace(/\{(\w+)\}/g, (_, key) => (typeof values[key] === "number" ? number(values[key], 0, { maximumFractionDigits: 2 }) : String(values[key])));
}

export const hasText = (name) => Object.hasOwn(en, name);

/** Replace the texts of elements with the attribute `data-text`, the name of a text. */
export function translate(root) {
  for (const element of root.querySelectorAll("[data-text]")) element.textContent = t(element.dataset.text);
}
