// An image on a canvas: true proportions, scales in metres, nadir side, hatched missing areas, measurements.

import { niceStep } from "./format.js";
import { colourTable, colourise, maskCanvas } from "./image_data.js";

const MARGIN = { left: 62, top: 26, right: 14, bottom: 42 };
const MAX_ZOOM = 64;

/** Default viewport, shared by images side by side. The centre is in fractions of the image's sides. */
export const defaultViewport = () => ({ zoom: 1, across: 0.5, along: 0.5 });

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

export class ImageView {
  constructor(canvas, viewport) {
    this.canvas = canvas;
    this.viewport = viewport;
    this.image = null;
    this.scale = null; // {along_m, across_m} of a pixel; null if unknown
    this.display = { map: "grey", low: 0, high: 100, gamma: 1, hatch: true };
    this.lines = []; // measurements: {from: [row, column], to, text, colour}
    this.crosshair = null; // [row, column] of the measurement crosshair
    this.title = "";
    this.nadir = null;
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  /** `synthesised`: the whole layer is not measurable, and is marked by a frame. */
  show(image, { scale = null, nadir = null, title = "", synthesised = false }) {
    Object.assign(this, { image, scale, nadir, title, synthesised });
    this.missing = image && maskCanvas(image.missing, image.width, image.height);
    this.guessed = image && maskCanvas(image.guessed, image.width, image.height);
    this.applyColours();
  }

  /** Apply gain and colour map of `display`. */
  applyColours() {
    const { map, low, high, gamma } = this.display;
    this.coloured = this.image && colourise(this.image, colourTable(map, low, high, gamma));
    this.draw();
  }

  /** Size of an image pixel (across, along) and the upper left corner of the image, in CSS pixels. */
  #geometry() {
    const box = { width: this.canvas.clientWidth - MARGIN.left - MARGIN.right, height: this.canvas.clientHeight - MARGIN.top - MARGIN.bottom };
    const across = this.scale?.across_m ?? 1;
    const along = this.scale?.along_m ?? 1;
    const size = { width: this.image.width * across, height: this.image.height * along };
    const fit = Math.min(box.width / size.width, box.height / size.height);
    const unit = fit * this.viewport.zoom;
    const x = MARGIN.left + box.width / 2 - this.viewport.across * size.width * unit;
    const y = MARGIN.top + box.height / 2 - this.viewport.along * size.height * unit;
    return { box, x, y, across: across * unit, along: along * unit };
  }

  /** [row, column] at a point of the canvas in CSS pixels. */
  pixelAt(x, y) {
    const g = this.#geometry();
    return [(y - g.y) / g.along, (x - g.x) / g.across];
  }

  #toCanvas([row, column]) {
    const g = this.#geometry();
    return [g.x + column * g.across, g.y + row * g.along];
  }

  /** Zoom by a factor about the point (x, y), or about the centre of the viewport. */
  zoom(factor, x = null, y = null) {
    if (!this.image) return;
    const before = x === null ? null : this.pixelAt(x, y);
    this.viewport.zoom = Math.max(1, Math.min(MAX_ZOOM, this.viewport.zoom * factor));
    if (before) {
      const after = this.pixelAt(x, y);
      this.pan((before[1] - after[1]) / this.image.width, (before[0] - after[0]) / this.image.height);
    }
    if (this.viewport.zoom === 1) Object.assign(this.viewport, defaultViewport());
  }

  /** Move by fractions of the image's sides. */
  pan(across, along) {
    if (this.viewport.zoom === 1) return;
    this.viewport.across = Math.max(0, Math.min(1, this.viewport.across + across));
    this.viewport.along = Math.max(0, Math.min(1, this.viewport.along + along));
  }

  /** Move by CSS pixels. */
  drag(dx, dy) {
    const g = this.#geometry();
    this.pan(-dx / (g.across * this.image.width), -dy / (g.along * this.image.height));
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
    if (!this.image) return;
    this.#drawImage(context);
    this.#drawScales(context, colour);
    this.#drawLines(context);
  }

  #drawImage(context) {
    const g = this.#geometry();
    const [width, height] = [this.image.width * g.across, this.image.height * g.along];
    context.save();
    context.beginPath();
    context.rect(MARGIN.left, MARGIN.top, g.box.width, g.box.height);
    context.clip();
    context.imageSmoothingEnabled = false;
    context.drawImage(this.coloured, g.x, g.y, width, height);
    if (this.display.hatch) {
      this.#drawMask(context, this.missing, hatch, g, width, height);
      if (!this.synthesised) this.#drawMask(context, this.guessed, dots, g, width, height);
    }
    if (this.synthesised) this.#drawFrame(context, g, width, height);
    context.restore();
  }

  /** Draw a pattern over a mask, in screen pixels: it does not change with the zoom. */
  #drawMask(context, mask, draw, g, width, height) {
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

  /** Mark a synthesised layer with a frame and text: dots would cover the whole image. */
  #drawFrame(context, g, width, height) {
    const [left, top] = [Math.max(g.x, MARGIN.left), Math.max(g.y, MARGIN.top)];
    const [right, bottom] = [Math.min(g.x + width, MARGIN.left + g.box.width), Math.min(g.y + height, MARGIN.top + g.box.height)];
    for (const [colour, dash] of [["#000000", []], ["#52e0ff", [8, 8]]]) {
      context.strokeStyle = colour;
      context.lineWidth = 4;
      context.setLineDash(dash);
      context.strokeRect(left + 2, top + 2, right - left - 4, bottom - top - 4);
    }
    context.setLineDash([]);
    this.#drawLabel(context, "NOT MEASURED", (left + right) / 2, bottom - 18, "#52e0ff");
  }

  #drawScales(context, colour) {
    const g = this.#geometry();
    const [right, bottom] = [MARGIN.left + g.box.width, MARGIN.top + g.box.height];
    context.strokeStyle = colour.line;
    context.fillStyle = colour.text;
    context.strokeRect(MARGIN.left - 0.5, MARGIN.top - 0.5, g.box.width + 1, g.box.height + 1);
    const unit = this.scale ? "m" : "px";
    const drawAxis = (pixel, from, length, corner, axis) => {
      const metre = pixel / (this.scale ? axis.size : 1);
      const step = niceStep(length / metre, axis.lines);
      const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
      for (let value = Math.ceil((from - corner) / metre / step - 1e-9) * step; corner + value * metre <= from + length + 0.5; value += step) {
        if (value >= -1e-9 && value <= axis.max + 1e-9) axis.draw(corner + value * metre, Math.abs(value).toFixed(digits));
      }
    };
    context.textAlign = "center";
    context.textBaseline = "top";
    drawAxis(g.across, MARGIN.left, g.box.width, g.x, {
      size: this.scale?.across_m, lines: g.box.width / 70, max: this.image.width * (this.scale?.across_m ?? 1),
      draw: (x, text) => { context.fillRect(x - 0.5, bottom, 1, 5); context.fillText(text, x, bottom + 6); },
    });
    context.fillText(`across-track, ${unit}`, (MARGIN.left + right) / 2, bottom + 23);
    context.textAlign = "right";
    context.textBaseline = "middle";
    drawAxis(g.along, MARGIN.top, g.box.height, g.y, {
      size: this.scale?.along_m, lines: g.box.height / 50, max: this.image.height * (this.scale?.along_m ?? 1),
      draw: (y, text) => { context.fillRect(MARGIN.left - 6, y - 0.5, 5, 1); context.fillText(text, MARGIN.left - 9, y); },
    });
    context.save();
    context.translate(11, (MARGIN.top + bottom) / 2);
    context.rotate(-Math.PI / 2);
    context.textAlign = "center";
    context.fillText(`along-track, ${unit}`, 0, 0);
    context.restore();
    context.textAlign = "left";
    context.fillText(this.nadir === "left" ? "◀ nadir" : "nadir side unknown", MARGIN.left, MARGIN.top - 13);
    context.textAlign = "right";
    const available = g.box.width - context.measureText("nadir side unknown").width;
    context.fillText(context.measureText(this.title).width < available ? this.title : this.title.split(" · ").slice(0, 2).join(" · "), right, MARGIN.top - 13);
  }

  #drawLines(context) {
    for (const line of this.lines) {
      const [x0, y0] = this.#toCanvas(line.from);
      const [x1, y1] = this.#toCanvas(line.to);
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
      this.#drawLabel(context, line.text, (x0 + x1) / 2, Math.max(MARGIN.top + 12, Math.min(y0, y1) - 14), line.colour);
    }
    if (this.crosshair) this.#drawCrosshair(context);
  }

  #drawLabel(context, text, x, y, colour) {
    context.textAlign = "center";
    context.textBaseline = "middle";
    const width = context.measureText(text).width + 10;
    context.fillStyle = "#000000d0";
    context.fillRect(x - width / 2, y - 10, width, 20);
    context.fillStyle = colour;
    context.fillText(text, x, y);
  }

  #drawCrosshair(context) {
    const [x, y] = this.#toCanvas(this.crosshair);
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
