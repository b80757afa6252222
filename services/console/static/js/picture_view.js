// One picture on a canvas: true proportions, scales in metres, nadir side, hatched gaps, lines of measurements.

import { niceStep } from "./format.js";
import { coloured, maskCanvas, table } from "./picture_data.js";

const MARGIN = { left: 62, top: 26, right: 14, bottom: 42 };
const MOST_ZOOM = 64;

/** Where two views look at, so that pictures side by side move together. Centre in shares of the picture's sides. */
export const freshSight = () => ({ zoom: 1, across: 0.5, along: 0.5 });

function pattern(context, draw) {
  const tile = new OffscreenCanvas(10, 10);
  draw(tile.getContext("2d"));
  return context.createPattern(tile, "repeat");
}

const hatch = (tile) => {
  tile.strokeStyle = "#ffcf4d";
  tile.lineWidth = 1.4;
  for (const x of [-10, 0, 10]) { tile.moveTo(x, 10); tile.lineTo(x + 10, 0); }
  tile.stroke();
};
const dots = (tile) => {
  tile.fillStyle = "#000000";
  tile.fillRect(1, 1, 4, 4);
  tile.fillStyle = "#52e0ff";
  tile.fillRect(2, 2, 2, 2);
};

export class PictureView {
  constructor(canvas, sight) {
    this.canvas = canvas;
    this.sight = sight;
    this.picture = null;
    this.scale = null; // {along_m, across_m} of a pixel, null where it is not known
    this.look = { map: "grey", low: 0, high: 100, gamma: 1, hatch: true };
    this.lines = []; // measurements: {from: [row, column], to, words, tone}
    this.cross = null; // [row, column] of the measuring crosshair
    this.title = "";
    this.nadir = null;
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  /** `made`: the whole layer is treated or made up; it then carries a frame that says so. */
  show(picture, { scale, nadir, title, made }) {
    Object.assign(this, { picture, scale, nadir, title, made });
    this.missing = picture && maskCanvas(picture.missing, picture.width, picture.height);
    this.guessed = picture && maskCanvas(picture.guessed, picture.width, picture.height);
    this.recolour();
  }

  /** Take gain and colour map as `look` has them now. */
  recolour() {
    const { map, low, high, gamma } = this.look;
    this.image = this.picture && coloured(this.picture, table(map, low, high, gamma));
    this.draw();
  }

  /** Screen pixels of a picture's pixel, (across, along), and the corner of the picture, in CSS pixels. */
  #geometry() {
    const box = { width: this.canvas.clientWidth - MARGIN.left - MARGIN.right, height: this.canvas.clientHeight - MARGIN.top - MARGIN.bottom };
    const across = this.scale?.across_m ?? 1;
    const along = this.scale?.along_m ?? 1;
    const size = { width: this.picture.width * across, height: this.picture.height * along };
    const fit = Math.min(box.width / size.width, box.height / size.height);
    const unit = fit * this.sight.zoom;
    const x = MARGIN.left + box.width / 2 - this.sight.across * size.width * unit;
    const y = MARGIN.top + box.height / 2 - this.sight.along * size.height * unit;
    return { box, x, y, across: across * unit, along: along * unit };
  }

  /** The [row, column] under a point of the canvas, in CSS pixels. */
  at(x, y) {
    const g = this.#geometry();
    return [(y - g.y) / g.along, (x - g.x) / g.across];
  }

  #point([row, column]) {
    const g = this.#geometry();
    return [g.x + column * g.across, g.y + row * g.along];
  }

  /** Zoom by a factor, keeping what lies under (x, y) where it is; in the middle where no point is given. */
  zoom(factor, x = null, y = null) {
    if (!this.picture) return;
    const before = x === null ? null : this.at(x, y);
    this.sight.zoom = Math.max(1, Math.min(MOST_ZOOM, this.sight.zoom * factor));
    if (before) {
      const after = this.at(x, y);
      this.pan((before[1] - after[1]) / this.picture.width, (before[0] - after[0]) / this.picture.height);
    }
    if (this.sight.zoom === 1) Object.assign(this.sight, freshSight());
  }

  /** Move by shares of the picture's sides. */
  pan(across, along) {
    if (this.sight.zoom === 1) return;
    this.sight.across = Math.max(0, Math.min(1, this.sight.across + across));
    this.sight.along = Math.max(0, Math.min(1, this.sight.along + along));
  }

  /** Move by CSS pixels. */
  drag(dx, dy) {
    const g = this.#geometry();
    this.pan(-dx / (g.across * this.picture.width), -dy / (g.along * this.picture.height));
  }

  draw() {
    const ratio = devicePixelRatio || 1;
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (width === 0 || height === 0) return;
    this.canvas.width = Math.round(width * ratio);
    this.canvas.height = Math.round(height * ratio);
    const context = this.canvas.getContext("2d");
    context.scale(ratio, ratio);
    const style = getComputedStyle(this.canvas);
    const colour = { text: style.color, line: style.borderTopColor, font: style.fontFamily };
    context.font = `${Math.max(12, 0.78 * parseFloat(style.fontSize))}px ${colour.font}`;
    if (!this.picture) return;
    this.#drawPicture(context);
    this.#drawScales(context, colour);
    this.#drawLines(context);
  }

  #drawPicture(context) {
    const g = this.#geometry();
    const [width, height] = [this.picture.width * g.across, this.picture.height * g.along];
    context.save();
    context.beginPath();
    context.rect(MARGIN.left, MARGIN.top, g.box.width, g.box.height);
    context.clip();
    context.imageSmoothingEnabled = false;
    context.drawImage(this.image, g.x, g.y, width, height);
    if (this.look.hatch) {
      this.#overlay(context, this.missing, hatch, g, width, height);
      if (!this.made) this.#overlay(context, this.guessed, dots, g, width, height);
    }
    if (this.made) this.#frame(context, g, width, height);
    context.restore();
  }

  /** Patterns are drawn in screen pixels, so that they look the same at every zoom and are no part of the picture. */
  #overlay(context, mask, draw, g, width, height) {
    if (!mask) return;
    const layer = new OffscreenCanvas(this.canvas.clientWidth, this.canvas.clientHeight);
    const paint = layer.getContext("2d");
    paint.imageSmoothingEnabled = false;
    paint.drawImage(mask, g.x, g.y, width, height);
    paint.globalCompositeOperation = "source-in";
    paint.fillStyle = pattern(paint, draw);
    paint.fillRect(0, 0, layer.width, layer.height);
    context.drawImage(layer, 0, 0);
  }

  /** A layer that is made up as a whole: a frame and words, as dots over all of it would hide it. */
  #frame(context, g, width, height) {
    const [left, top] = [Math.max(g.x, MARGIN.left), Math.max(g.y, MARGIN.top)];
    const [right, bottom] = [Math.min(g.x + width, MARGIN.left + g.box.width), Math.min(g.y + height, MARGIN.top + g.box.height)];
    for (const [colour, dash] of [["#000000", []], ["#52e0ff", [8, 8]]]) {
      context.strokeStyle = colour;
      context.lineWidth = 4;
      context.setLineDash(dash);
      context.strokeRect(left + 2, top + 2, right - left - 4, bottom - top - 4);
    }
    context.setLineDash([]);
    this.#label(context, "NOT MEASURED", (left + right) / 2, bottom - 18, "#52e0ff");
  }

  #drawScales(context, colour) {
    const g = this.#geometry();
    const [right, bottom] = [MARGIN.left + g.box.width, MARGIN.top + g.box.height];
    context.strokeStyle = colour.line;
    context.fillStyle = colour.text;
    context.strokeRect(MARGIN.left - 0.5, MARGIN.top - 0.5, g.box.width + 1, g.box.height + 1);
    const unit = this.scale ? "m" : "px";
    const axis = (pixel, from, length, corner, place) => {
      const metre = pixel / (this.scale ? place.size : 1);
      const step = niceStep(length / metre, place.lines);
      const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
      for (let value = Math.ceil((from - corner) / metre / step - 1e-9) * step; corner + value * metre <= from + length + 0.5; value += step) {
        if (value >= -1e-9 && value <= place.most + 1e-9) place.draw(corner + value * metre, Math.abs(value).toFixed(digits));
      }
    };
    context.textAlign = "center";
    context.textBaseline = "top";
    axis(g.across, MARGIN.left, g.box.width, g.x, {
      size: this.scale?.across_m, lines: g.box.width / 70, most: this.picture.width * (this.scale?.across_m ?? 1),
      draw: (x, words) => { context.fillRect(x - 0.5, bottom, 1, 5); context.fillText(words, x, bottom + 6); },
    });
    context.fillText(`across-track, ${unit}`, (MARGIN.left + right) / 2, bottom + 23);
    context.textAlign = "right";
    context.textBaseline = "middle";
    axis(g.along, MARGIN.top, g.box.height, g.y, {
      size: this.scale?.along_m, lines: g.box.height / 50, most: this.picture.height * (this.scale?.along_m ?? 1),
      draw: (y, words) => { context.fillRect(MARGIN.left - 6, y - 0.5, 5, 1); context.fillText(words, MARGIN.left - 9, y); },
    });
    context.save();
    context.translate(11, (MARGIN.top + bottom) / 2);
    context.rotate(-Math.PI / 2);
    context.textAlign = "center";
    context.fillText(`along-track, ${unit}`, 0, 0);
    context.restore();
    context.textAlign = "left";
    context.fillText(this.nadir === "left" ? "◀ nadir" : "nadir side not known", MARGIN.left, MARGIN.top - 13);
    context.textAlign = "right";
    const room = g.box.width - context.measureText("nadir side not known").width;
    context.fillText(context.measureText(this.title).width < room ? this.title : this.title.split(" · ").slice(0, 2).join(" · "), right, MARGIN.top - 13);
  }

  #drawLines(context) {
    for (const line of this.lines) {
      const [x0, y0] = this.#point(line.from);
      const [x1, y1] = this.#point(line.to);
      for (const [colour, width] of [["#000000", 5], [line.colour, 2.2]]) {
        context.strokeStyle = colour;
        context.lineWidth = width;
        context.beginPath();
        context.moveTo(x0, y0);
        context.lineTo(x1, y1);
        const length = Math.hypot(x1 - x0, y1 - y0) || 1;
        const [tx, ty] = [(-(y1 - y0) / length) * 7, ((x1 - x0) / length) * 7];
        for (const [x, y] of [[x0, y0], [x1, y1]]) { context.moveTo(x - tx, y - ty); context.lineTo(x + tx, y + ty); }
        context.stroke();
      }
      this.#label(context, line.words, (x0 + x1) / 2, Math.max(MARGIN.top + 12, Math.min(y0, y1) - 14), line.colour);
    }
    if (this.cross) this.#drawCross(context);
  }

  #label(context, words, x, y, colour) {
    context.textAlign = "center";
    context.textBaseline = "middle";
    const width = context.measureText(words).width + 10;
    context.fillStyle = "#000000d0";
    context.fillRect(x - width / 2, y - 10, width, 20);
    context.fillStyle = colour;
    context.fillText(words, x, y);
  }

  #drawCross(context) {
    const [x, y] = this.#point(this.cross);
    for (const [colour, width] of [["#000000", 4], ["#ffffff", 1.5]]) {
      context.strokeStyle = colour;
      context.lineWidth = width;
      context.beginPath();
      for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
        context.moveTo(x + 4 * dx, y + 4 * dy);
        context.lineTo(x + 16 * dx, y + 16 * dy);
      }
      context.stroke();
    }
  }
}
