// Geometry of an image: from pixels to metres in slant or ground range, and to the screen in one of three orientations.

/** Orientations of the image on the screen. */
export const ORIENTATIONS = ["nadir", "above", "north"];
/** Least ratio of the sides of an image that is turned so that its long side lies along that of the screen. */
const TURN_RATIO = 1.5;

/**
 * What is known of an image.
 *
 * @typedef {object} Geometry
 * @property {{along_m: number, across_m: number} | null} [scale] size of a pixel
 * @property {ImageMark | null} [mark] place of the contact
 * @property {Version["box"]} [box] area of the contact
 * @property {"slant" | "ground" | null} [range_axis]
 * @property {number | null} [altitude_m] of the vehicle
 * @property {number | null} [heading_deg] of the vehicle
 * @property {string | null} [side] of the vehicle
 */

export class Projection {
  /**
   * @param {{width: number, height: number}} image
   * @param {Geometry} geometry
   */
  constructor(image, { scale = null, mark = null, box = null, range_axis = null, altitude_m = null, heading_deg = null, side = null }) {
    this.width = image.width;
    this.height = image.height;
    this.scale = scale;
    this.mark = mark;
    this.box = box;
    this.range_axis = range_axis;
    this.altitude_m = altitude_m;
    this.heading_deg = heading_deg;
    this.side = side;
    this.along = scale?.along_m ?? 1;
    this.across = scale?.across_m ?? 1;
    this.ground = false;
    this.orientation = "nadir";
    this.turned = false;
  }

  /** Whether slant range can be converted to ground range. */
  get convertible() { return this.range_axis === "slant" && this.mark !== null && this.scale !== null && this.altitude_m !== null && this.slantAt(this.width) > this.altitude_m; }

  /** Whether an orientation can be displayed. */
  orientable(name) {
    return name === "nadir" || (this.side !== null && (name === "above" || this.heading_deg !== null));
  }

  /**
   * Select ground range and orientation; what is not known stays slant range, as received.
   *
   * A long image is turned clockwise by 90° if its long side then lies along the long side of `room`; north stays up.
   * @param {{ground: boolean, orientation: string}} display
   * @param {{width: number, height: number}} room
   */
  select({ ground, orientation }, room) {
    this.ground = ground && this.convertible;
    this.orientation = this.orientable(orientation) ? orientation : "nadir";
    this.origin = this.ground ? this.groundAt(0) : 0;
    this.extent = [this.#across(this.width), this.height * this.along];
    const [width, height] = this.extent;
    const isLong = Math.max(width, height) >= TURN_RATIO * Math.min(width, height);
    this.turned = this.orientation !== "north" && isLong && width > height !== room.width > room.height;
    const turn = this.orientation === "north" ? (this.heading_deg * Math.PI) / 180 : this.turned ? Math.PI / 2 : 0;
    const [x, y] = this.orientation === "nadir" ? [1, 1] : [this.side === "starboard" ? 1 : -1, -1];
    // Columns of the matrix: directions on the screen of "away from the nadir" and of "next row".
    /** @type {[number, number, number, number]} */
    this.matrix = [x * Math.cos(turn), x * Math.sin(turn), -y * Math.sin(turn), y * Math.cos(turn)];
  }

  /** Slant range of a column. */
  slantAt(column) { return this.mark.range_m + (column - this.mark.column) * this.across; }

  /** Ground range of a column; 0 in the water column. */
  groundAt(column) { return Math.sqrt(Math.max(0, this.slantAt(column) ** 2 - this.altitude_m ** 2)); }

  #across(column) { return this.ground ? this.groundAt(column) - this.origin : column * this.across; }

  /**
   * Metres from the first column and first row; [x, y].
   *
   * @param {Point} pixel
   * @returns {Point}
   */
  toPlane([row, column]) { return [this.#across(column), row * this.along]; }

  /**
   * [row, column] of a point in metres.
   *
   * @param {Point} metres
   * @returns {Point}
   */
  fromPlane([x, y]) { return [y / this.along, this.columnAt(x)]; }

  columnAt(x) {
    if (!this.ground) return x / this.across;
    return this.mark.column + (Math.hypot(x + this.origin, this.altitude_m) - this.mark.range_m) / this.across;
  }

  /** Length in metres of a line; on the seabed, where slant range can be converted. */
  length([row, column], [endRow, endColumn], { toGround }) {
    const convert = toGround && this.convertible && this.slantAt(Math.min(column, endColumn)) > 1.05 * (this.altitude_m + 0.25);
    const across = convert ? this.groundAt(endColumn) - this.groundAt(column) : (endColumn - column) * this.across;
    return Math.hypot((endRow - row) * this.along, across);
  }

  /** Range at the first column of the view; null if unknown. */
  get firstRange() {
    if (this.mark === null || this.scale === null) return null;
    return this.ground ? this.origin : this.slantAt(0);
  }

  /** Half the interval in which the range of a column lies, in metres. */
  get rangeError() { return this.mark === null ? 0 : ((this.mark.columns[1] - this.mark.columns[0]) / 2) * this.across; }

  /** Direction of north on the screen, as a unit vector; null if unknown. */
  get north() {
    if (this.heading_deg === null || this.side === null) return null;
    const heading = (this.heading_deg * Math.PI) / 180;
    const x = (this.side === "starboard" ? -1 : 1) * Math.sin(heading);
    const y = Math.cos(heading);
    const [a, b, c, d] = this.matrix;
    return [a * x + c * y, b * x + d * y];
  }

  /** The image as it is drawn: resampled to equal steps of ground range, or the image itself. */
  resample(image, smooth) {
    if (!this.ground) return image;
    const width = Math.max(1, Math.round(this.extent[0] / this.across));
    const step = this.extent[0] / width;
    const size = width * image.height;
    const out = { width, height: image.height, levels: new Uint8Array(size), missing: new Uint8Array(size) };
    for (let x = 0; x < width; x += 1) {
      const column = Math.max(0, Math.min(image.width - 1e-6, this.columnAt((x + 0.5) * step)));
      const nearest = Math.floor(column);
      const left = Math.max(0, Math.min(image.width - 1, Math.floor(column - 0.5)));
      const right = Math.min(image.width - 1, left + 1);
      const part = smooth ? Math.max(0, Math.min(1, column - 0.5 - left)) : 0;
      for (let y = 0; y < image.height; y += 1) {
        const row = y * image.width;
        const [from, to] = smooth ? [left, right] : [nearest, nearest];
        out.levels[y * width + x] = Math.round((1 - part) * image.levels[row + from] + part * image.levels[row + to]);
        out.missing[y * width + x] = image.missing[row + nearest];
      }
    }
    return out;
  }
}
