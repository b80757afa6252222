// Measurement on the image with two points, by mouse or keyboard. The server computes value, uncertainty and height,
// and refuses synthesised layers and missing pixels.

import { api } from "./api.js";
import { toast } from "./dom.js";
import { withSigma } from "./format.js";

export const KINDS = ["length", "width", "shadow"];
const COLOURS = { length: "#7dff8a", width: "#6fd3ff", shadow: "#ffb347" };

export function measurementLine(measurement) {
  const height = measurement.height_m === null || measurement.height_m === undefined ? "" : ` → height ${withSigma(measurement.height_m, measurement.height_sigma_m)}`;
  return {
    from: measurement.from, to: measurement.to, colour: COLOURS[measurement.kind],
    text: `${measurement.kind} ${withSigma(measurement.value_m, measurement.sigma_m)}${height}`,
  };
}

export class MeasurementTool {
  /** `displayed()` returns `{id, version, layer, scale, image}`; `changed()` is called after each change of the lines. */
  constructor(displayed, changed) {
    this.displayed = displayed;
    this.changed = changed;
    this.kind = null; // null if inactive
    this.from = null;
    this.crosshair = null;
    this.result = null;
  }

  get active() { return this.kind !== null; }

  start(kind) {
    const { image } = this.displayed();
    this.kind = kind;
    this.from = null;
    this.result = null;
    this.crosshair ??= [image.height / 2, image.width / 2];
    this.changed();
  }

  /** Start the next kind of measurement; after the last kind, stop. */
  next() {
    const index = this.active ? KINDS.indexOf(this.kind) + 1 : 0;
    if (index < KINDS.length) this.start(KINDS[index]);
    else this.stop();
  }

  stop() {
    this.kind = null;
    this.from = null;
    this.crosshair = null;
    this.result = null;
    this.changed();
  }

  /** Remove the points, or stop. */
  back() {
    if (this.result || this.from) {
      this.result = null;
      this.from = null;
      this.changed();
    } else this.stop();
  }

  move(rows, columns) {
    const { image } = this.displayed();
    this.moveTo([this.crosshair[0] + rows, this.crosshair[1] + columns], image);
  }

  /** Move the crosshair to a point, limited to the image. */
  moveTo([row, column], image = this.displayed().image) {
    this.crosshair = [Math.max(0, Math.min(image.height, row)), Math.max(0, Math.min(image.width, column))];
    this.changed();
  }

  /** Set the first point, then the second one, which requests the result; the third call stores the measurement. */
  async setPoint() {
    if (this.result) return this.keep();
    if (!this.from) {
      this.from = [...this.crosshair];
      this.changed();
      return null;
    }
    return this.#request([...this.crosshair], false);
  }

  async keep() {
    if (!this.result) return null;
    const stored = await this.#request(this.result.to, true);
    if (stored) {
      toast(`Kept: ${measurementLine(stored).text}`);
      this.stop();
    }
    return stored;
  }

  async #request(to, keep) {
    const { id, version, layer } = this.displayed();
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

  /** Lines to draw during a measurement. */
  lines() {
    if (!this.active) return [];
    if (this.result) return [measurementLine(this.result)];
    if (!this.from) return [];
    const { scale } = this.displayed();
    const length = Math.hypot((this.crosshair[0] - this.from[0]) * scale.along_m, (this.crosshair[1] - this.from[1]) * scale.across_m);
    return [{ from: this.from, to: this.crosshair, colour: COLOURS[this.kind], text: `${this.kind} ${length.toFixed(2)}\u202fm` }];
  }
}
