// Unsent input of the decision form, by contact. This browser keeps it over a reload and the end of a session.

const MAX_DRAFTS = 50;
const EMPTY = { verdict: null, confidence: null, mlo_class: "", remark: "" };

export class Drafts {
  /** `user`: the drafts of each user are separate. */
  constructor(user) {
    this.key = `sonarpost.drafts.${user}`;
    /** @type {Map<string, {name: string, verdict: string | null, confidence: number | null, mlo_class: string, remark: string}>} */
    this.drafts = new Map();
    try { this.drafts = new Map(JSON.parse(localStorage.getItem(this.key) ?? "[]")); } catch { /* kept for this page only */ }
    this.restored = new Set(this.drafts.keys()); // contacts with a draft of an earlier page
  }

  /** The contact of the latest draft; null without drafts. */
  get latest() {
    const [id, draft] = [...this.drafts].at(-1) ?? [];
    return id ? { id, name: draft.name ?? id } : null;
  }

  get(id) { return { ...EMPTY, ...this.drafts.get(id) }; }

  /** Change fields of a draft. A draft without input is removed, and the oldest one of more than 50. */
  change({ id, name }, fields) {
    const draft = { ...this.get(id), ...fields, name };
    this.drafts.delete(id);
    if (Object.keys(EMPTY).some((name) => draft[name] !== EMPTY[name])) this.drafts.set(id, draft);
    if (this.drafts.size > MAX_DRAFTS) this.drafts.delete(this.drafts.keys().next().value);
    this.#store();
  }

  remove(id) {
    this.drafts.delete(id);
    this.restored.delete(id);
    this.#store();
  }

  #store() {
    try { localStorage.setItem(this.key, JSON.stringify([...this.drafts])); } catch { /* kept for this page only */ }
  }
}
