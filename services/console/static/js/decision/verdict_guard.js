// Guard of verdicts: they count after the image was in sight, and many in a short time need a confirmation.

/** Time for which an image is in sight before a verdict on it counts. */
export const SEEN_MS = 300;
const MANY = 3;
const MANY_MS = 2000;

export class VerdictGuard {
  /**
   * @param {() => boolean} inSight Whether the image of the displayed contact is drawn and not hidden.
   * @param {(ready: boolean) => void} changed Called when verdicts begin or cease to count.
   */
  constructor(inSight, changed) {
    this.inSight = inSight;
    this.changed = changed;
    /** @type {string | null} */
    this.id = null; // identifier of the displayed contact
    /** @type {number | null} */
    this.drawn_ms = null; // time of the first frame with its image
    this.timer = 0;
    /** @type {number[]} */
    this.sent_ms = []; // times of the latest verdicts
    this.ready = false;
    document.addEventListener("visibilitychange", () => this.restart());
  }

  /** A contact is displayed, or its new state. */
  show(id) {
    if (id === this.id && this.timer) return;
    if (id !== this.id) this.drawn_ms = null;
    this.id = id;
    this.restart();
  }

  /** Wait again: another view or page has covered the image, or another contact was to follow. */
  restart() {
    clearTimeout(this.timer);
    this.timer = 0;
    this.#set(false);
    const { id } = this;
    // The first callback is before the frame with the image is painted, the second one after it.
    requestAnimationFrame(() => requestAnimationFrame(() => {
      if (id === null || id !== this.id || this.timer || document.hidden || !this.inSight()) return;
      this.drawn_ms ??= performance.now();
      this.timer = setTimeout(() => this.#set(true), SEEN_MS);
    }));
  }

  #set(ready) {
    this.ready = ready;
    this.changed(ready);
  }

  /** Seconds since the first frame with the image of the contact. */
  get shown_s() { return Math.min(86400, (performance.now() - this.drawn_ms) / 1000); }

  /** Whether a verdict at present is one of more than three within two seconds. */
  get isMany() { return this.sent_ms.filter((time_ms) => performance.now() - time_ms < MANY_MS).length >= MANY; }

  /** A verdict is sent. A confirmed one begins a new count. */
  sent(confirmed) { this.sent_ms = confirmed ? [] : [...this.sent_ms.slice(1 - MANY), performance.now()]; }
}
