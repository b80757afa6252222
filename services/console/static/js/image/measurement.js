// Measurement on the image with a line, by mouse, touch or keyboard. The server moves the ends to half brightness,
// computes value, uncertainty and height, and refuses other layers and missing pixels.

import { api } from "../base/api.js";
import { toast } from "../base/dom.js";
import { quantity, withSigma } from "../base/format.js";
import { t } from "../texts.js";

export const KINDS = ["length", "width", "shadow"];
const COLOURS = { length: "#7dff8a", width: "#6fd3ff", shadow: "#ffb347" };

/**
 * Line and texts of a measurement.
 * @param {Record<string, any>} measurement as the server returns it
 * @returns {{from: number[], to: number[], colour: string, label: string, text: string}}
 */
export function measurementLine(measurement) {
  const { kind, metres } = measurement;
  const known = typeof measurement.height_m === "number";
  const height = known ? ` → ${t("measure.height")} ${withSigma(measurement.height_m, measurement.height_sigma_m)}` : ` (${t("measure.no_height")})`;
  const range = !metres || metres === "ground" ? "" : ` ${t(`measure.metres_${metres}`)}`;
  // An end without an edge stays where it was set.
  const label = `${t(`measure.${kind}`)} ${withSigma(measurement.value_m, measurement.sigma_m)}${measurement.snapped?.includes(false) ? ` (${t("measure.no_edge")})` : ""}`;
  return { from: measurement.from, to: measurement.to, colour: COLOURS[kind], label, text: `${label}${kind === "shadow" ? height : range}` };
}

export class MeasurementTool {
  /** `displayed()` returns `{id, version, layer, image, projection}`; `changed()` is called after each change of the lines. */
  constructor(displayed, changed) {
    this.displayed = displayed;
    this.changed = changed;
    this.kind = null; // null if inactive
    this.number = 0; // last request for a result
    this.#reset();
  }

  #reset() {
    this.from = null;
    this.crosshair = null;
    this.line = null; // the line of the result as it was drawn, [from, to]
    this.result = null; // its ends are at half brightness
  }

  get active() { return this.kind !== null; }

  start(kind) {
    const { image } = this.displayed();
    this.kind = kind;
    this.crosshair ??= [image.height / 2, image.width / 2];
    this.clear();
  }

  /** Start the next kind of measurement; after the last kind, stop. */
  next() {
    const index = this.active ? KINDS.indexOf(this.kind) + 1 : 0;
    if (index < KINDS.length) this.start(KINDS[index]);
    else this.stop();
  }

  stop() {
    this.kind = null;
    this.number += 1;
    this.#reset();
    this.changed();
  }

  /** Remove the points; a result that is on its way is not theirs. */
  clear() {
    this.result = null;
    this.from = null;
    this.number += 1;
    this.changed();
  }

  /** Remove the points, or stop. */
  back() {
    if (this.result || this.from) this.clear();
    else this.stop();
  }

  move(rows, columns) {
    this.moveTo([this.crosshair[0] + rows, this.crosshair[1] + columns]);
  }

  /** Move the crosshair to a point, limited to the image; the end of a shadow stays in the row of its start. */
  moveTo([row, column]) {
    const { image } = this.displayed();
    const snapped = this.kind === "shadow" && this.from && !this.result ? this.from[0] : row;
    this.crosshair = [Math.max(0, Math.min(image.height, snapped)), Math.max(0, Math.min(image.width, column))];
    this.changed();
  }

  /** The pointer is pressed: on an end of the result (`grabbed`), or at the start of a line, or at its second end. */
  press(grabbed, point) {
    if (this.result && grabbed) {
      this.from = this.line[grabbed === "to" ? 0 : 1];
      this.result = null;
      this.moveTo(point);
      this.pressed = "second";
      return;
    }
    if (this.result) this.clear();
    this.pressed = this.from ? "second" : "first";
    this.moveTo(point);
    if (this.pressed === "first") {
      this.from = [...this.crosshair];
      this.changed();
    }
  }

  /** The pointer is released; a line that was drawn by a drag, or whose second end was clicked, is complete. */
  async release(completed, moved) {
    if (!this.active || !this.from) return;
    if (!completed) this.clear();
    else if (moved || this.pressed === "second") await this.#request([this.from, [...this.crosshair]], false);
  }

  /** Set the first point, then the second one, which requests the result; the third call stores the measurement. */
  setPoint() {
    if (this.result) return this.keep();
    if (!this.from) {
      this.from = [...this.crosshair];
      this.changed();
      return null;
    }
    return this.#request([this.from, [...this.crosshair]], false);
  }

  /** Store the result, and start the next kind. */
  async keep() {
    if (!this.result) return null;
    const stored = await this.#request(this.line, true);
    if (stored) {
      toast(t("measure.kept", { text: measurementLine(stored).text }));
      this.next();
    }
    return stored;
  }

  /**
   * Request the result of a line.
   * @param {number[][]} line its ends as they were drawn
   * @param {boolean} keep whether the server stores it
   */
  async #request(line, keep) {
    const { id, version, layer } = this.displayed();
    const number = (this.number += 1);
    try {
      const result = await api.measure(id, { version, layer, kind: this.kind, from: line[0], to: line[1], keep });
      if (number !== this.number) return null;
      this.line = line;
      this.result = result;
      this.changed();
      return result;
    } catch (error) {
      toast(error.message, { bad: true });
      if (number === this.number) this.clear();
      return null;
    }
  }

  /** Lines to draw during a measurement. */
  lines() {
    if (!this.active) return [];
    const profile = this.kind === "shadow";
    if (this.result) return [{ ...measurementLine(this.result), profile }];
    if (!this.from) return [];
    const length = this.displayed().projection.length(this.from, this.crosshair, { toGround: this.kind !== "shadow" });
    return [{ from: this.from, to: this.crosshair, colour: COLOURS[this.kind], label: `${t(`measure.${this.kind}`)} ${quantity(length, "m", 2)}`, profile }];
  }
}
