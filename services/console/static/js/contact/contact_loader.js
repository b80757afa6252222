// Data and images of contacts, loaded together. The next contacts of the queue are loaded in advance.

import { api } from "../base/api.js";

const MAX_CONTACTS = 8;

export class ContactLoader {
  /** `prepare(detail)` loads the images that the contact view displays first. */
  constructor(prepare) {
    this.prepare = prepare;
    this.entries = new Map(); // contact → {stale, ready: promise of {detail, prepared}}
  }

  #entry(id) {
    if (!this.entries.has(id)) {
      const ready = api.contact(id).then(async (detail) => ({ detail, prepared: await this.prepare(detail) }));
      const entry = { stale: false, ready };
      ready.catch(() => { if (this.entries.get(id) === entry) this.entries.delete(id); });
      this.entries.set(id, entry);
      while (this.entries.size > MAX_CONTACTS) this.entries.delete(this.entries.keys().next().value);
    }
    return this.entries.get(id);
  }

  /** Load a contact, or take it from those loaded in advance: `{detail, prepared, stale}`, `stale` when it has changed since. */
  async load(id) {
    const entry = this.#entry(id);
    return Object.assign(entry, await entry.ready);
  }

  prefetch(ids) {
    for (const id of ids) this.#entry(id);
  }

  /** Discard what was loaded of a contact: it has changed, or is displayed. */
  forget(id) {
    const entry = this.entries.get(id);
    if (entry) entry.stale = true;
    this.entries.delete(id);
  }

  clear() {
    for (const id of [...this.entries.keys()]) this.forget(id);
  }
}
