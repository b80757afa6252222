// Measuring on the picture: two points by mouse or by keys. The server computes value, uncertainty and height, and
// refuses where the picture is made up or missing; nothing is computed here that is not shown as the server said it.

import { api } from "./api.js";
import { toast } from "./dom.js";
import { withSigma } from "./format.js";

export const KINDS = ["length", "width", "shadow"];
const COLOURS = { length: "#7dff8a", width: "#6fd3ff", shadow: "#ffb347" };

export function lineOf(measurement) {
  const height = measurement.height_m === null || measurement.height_m === undefined ? "" : ` → height ${withSigma(measurement.height_m, measurement.height_sigma_m)}`;
  return {
    from: measurement.from, to: measurement.to, colour: COLOURS[measurement.kind],
    words: `${measurement.kind} ${withSigma(measurement.value_m, measurement.sigma_m)}${height}`,
  };
}

export class Measuring {
  /** `place()` gives `{id, version, layer, scale, picture}` on the screen; `changed()` is called when lines have changed. */
  constructor(place, changed) {
    this.place = place;
    this.changed = changed;
    this.kind = null; // what is measured, null while nothing is
    this.from = null;
    this.cross = null;
    this.result = null;
  }

  get active() { return this.kind !== null; }

  start(kind) {
    const { picture } = this.place();
    this.kind = kind;
    this.from = null;
    this.result = null;
    this.cross ??= [picture.height / 2, picture.width / 2];
    this.changed();
  }

  /** The next kind; after the last, measuring ends. */
  next() {
    const index = this.active ? KINDS.indexOf(this.kind) + 1 : 0;
    if (index < KINDS.length) this.start(KINDS[index]);
    else this.stop();
  }

  stop() {
    this.kind = null;
    this.from = null;
    this.cross = null;
    this.result = null;
    this.changed();
  }

  /** Take back the last point, or end measuring. */
  back() {
    if (this.result || this.from) {
      this.result = null;
      this.from = null;
      this.changed();
    } else this.stop();
  }

  move(rows, columns) {
    const { picture } = this.place();
    this.to([this.cross[0] + rows, this.cross[1] + columns], picture);
  }

  /** Put the crosshair somewhere within the picture. */
  to([row, column], picture = this.place().picture) {
    this.cross = [Math.max(0, Math.min(picture.height, row)), Math.max(0, Math.min(picture.width, column))];
    this.changed();
  }

  /** Set a point: the first, then the second, which asks the server; a third press keeps the measurement. */
  async set() {
    if (this.result) return this.keep();
    if (!this.from) {
      this.from = [...this.cross];
      this.changed();
      return null;
    }
    return this.#ask([...this.cross], false);
  }

  async keep() {
    if (!this.result) return null;
    const kept = await this.#ask(this.result.to, true);
    if (kept) {
      toast(`Kept: ${lineOf(kept).words}`);
      this.stop();
    }
    return kept;
  }

  async #ask(to, keep) {
    const { id, version, layer } = this.place();
    try {
      const result = await api.measure(id, { version, layer, kind: this.kind, from: this.from, to, keep });
      this.result = result;
      this.changed();
      return result;
    } catch (error) {
      toast(error.body?.reason ?? error.message, { bad: true });
      this.from = null;
      this.result = null;
      this.changed();
      return null;
    }
  }

  /** What is drawn while measuring. */
  lines() {
    if (!this.active) return [];
    if (this.result) return [lineOf(this.result)];
    if (!this.from) return [];
    const { scale } = this.place();
    const length = Math.hypot((this.cross[0] - this.from[0]) * scale.along_m, (this.cross[1] - this.from[1]) * scale.across_m);
    return [{ from: this.from, to: this.cross, colour: COLOURS[this.kind], words: `${this.kind} ${length.toFixed(2)}\u202fm` }];
  }
}
