// An image on a canvas: true proportions, slant or ground range, orientation, hatched missing areas, overlays.

import { colourTable, colourise, maskCanvas } from "./image_data.js";
import { MARGIN, axesOf, captionOf, drawAxes, drawCaption, drawCrosshair, drawLine, drawLines, drawMark, drawNorth } from "./image_overlays.js";
import { Projection } from "./image_projection.js";
import { t } from "../texts.js";

const MAX_ZOOM = 64;
export const LOUPE_ZOOM = 4;

/** Default viewport, shared by images side by side. The centre is in fractions of the image's sides. */
export const defaultViewport = () => ({ zoom: 1, across: 0.5, along: 0.5 });

function hatchPattern(context) {
  const canvas = new OffscreenCanvas(10, 10);
  const tile = canvas.getContext("2d");
  tile.strokeStyle = "#ffcf4d";
  tile.lineWidth = 1.4;
  for (const x of [-10, 0, 10]) { tile.moveTo(x, 10); tile.lineTo(x + 10, 0); }
  tile.stroke();
  return context.createPattern(canvas, "repeat");
}

export class ImageView {
  constructor(canvas, viewport) {
    this.canvas = canvas;
    this.viewport = viewport;
    this.image = null;
    this.projection = null;
    this.display = { map: "grey", low: 0, high: 100, smooth: null, grid: true, ground: false, orientation: "nadir" };
    this.lines = []; // measurements: {from: [row, column], to, label, colour, profile, outline: without end marks}
    this.crosshair = null; // [row, column] of the measurement crosshair
    this.title = "";
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  get scale() { return this.projection?.scale ?? null; }

  /** Whether pixels are interpolated: by default, where they are not square. */
  get smooth() {
    const { along, across } = this.projection ?? { along: 1, across: 1 };
    return this.display.smooth ?? Math.abs(along / across - 1) > 0.01;
  }

  /** `geometry`: see `Projection`. */
  show(image, { geometry = {}, title = "" }) {
    Object.assign(this, { image, title });
    this.projection = image && new Projection(image, geometry);
    this.applyColours();
  }

  /** Apply projection, gain and colour map of `display`. */
  applyColours() {
    if (this.image) {
      const { map, low, high } = this.display;
      this.projection.select(this.display, this.#room());
      const drawn = this.projection.resample(this.image, this.smooth);
      this.coloured = colourise(drawn, colourTable(map, low, high));
      this.missing = maskCanvas(drawn.missing, drawn.width, drawn.height);
    }
    this.draw();
  }

  /** Room for the image on a canvas of a size, by default the present one, in CSS pixels. */
  #room(width = this.canvas.clientWidth, height = this.canvas.clientHeight) {
    return { width: Math.max(1, width - MARGIN.left - MARGIN.right), height: Math.max(1, height - MARGIN.top - MARGIN.bottom) };
  }

  /** Largest scale at which the whole image fits into a room, in CSS pixels per metre. */
  #fit(room) {
    const [width, height] = this.projection.extent;
    const [a, b, c, d] = this.projection.matrix;
    return Math.min(room.width / (Math.abs(a) * width + Math.abs(c) * height), room.height / (Math.abs(b) * width + Math.abs(d) * height));
  }

  /** Scale of the whole image on a canvas of another size, in CSS pixels per metre. */
  scaleOn(width, height) {
    const room = this.#room(width, height);
    this.projection.select(this.display, room);
    return this.#fit(room);
  }

  /** Pixels per metre (`unit`), and functions between metres of the plane, image pixels and the canvas in CSS pixels. */
  #geometry() {
    const room = this.#room();
    const { projection } = this;
    const [width, height] = projection.extent;
    const [a, b, c, d] = projection.matrix;
    const unit = this.#fit(room) * this.viewport.zoom;
    const centre = [this.viewport.across * width, this.viewport.along * height];
    const [x0, y0] = [MARGIN.left + room.width / 2, MARGIN.top + room.height / 2];
    // The box is that of the whole image, or the room for an enlarged one.
    const whole = this.viewport.zoom === 1;
    const size = { width: whole ? (Math.abs(a) * width + Math.abs(c) * height) * unit : room.width, height: whole ? (Math.abs(b) * width + Math.abs(d) * height) * unit : room.height };
    const box = { ...size, left: x0 - size.width / 2, top: y0 - size.height / 2 };
    const screen = (/** @type {Point} */ [x, y]) => {
      const [dx, dy] = [(x - centre[0]) * unit, (y - centre[1]) * unit];
      return /** @type {Point} */ ([x0 + a * dx + c * dy, y0 + b * dx + d * dy]);
    };
    const plane = (/** @type {Point} */ [x, y]) => {
      const [dx, dy] = [(x - x0) / unit, (y - y0) / unit];
      return /** @type {Point} */ ([centre[0] + a * dx + b * dy, centre[1] + c * dx + d * dy]);
    };
    const clip = (context) => { context.beginPath(); context.rect(box.left, box.top, box.width, box.height); context.clip(); };
    return { box, unit, screen, plane, clip, toCanvas: (point) => screen(projection.toPlane(point)) };
  }

  /** [row, column] at a point of the canvas in CSS pixels. */
  pixelAt(x, y) { return this.projection.fromPlane(this.#geometry().plane([x, y])); }

  /** Point of the canvas in CSS pixels of [row, column]. */
  canvasAt(point) { return this.#geometry().toCanvas(point); }

  /** Rows and columns of a movement on the screen, in the orientation of the view. */
  turned(rows, columns) {
    const [a, b, c, d] = this.projection.matrix;
    return [c * columns + d * rows, a * columns + b * rows];
  }

  /** Zoom by a factor about the point (x, y), or about the centre of the viewport. */
  zoom(factor, x = null, y = null) {
    if (!this.image) return;
    const before = x === null ? null : this.#geometry().plane([x, y]);
    this.viewport.zoom = Math.max(1, Math.min(MAX_ZOOM, this.viewport.zoom * factor));
    if (before) {
      const after = this.#geometry().plane([x, y]);
      this.#move(before[0] - after[0], before[1] - after[1]);
    }
    if (this.viewport.zoom === 1) Object.assign(this.viewport, defaultViewport());
  }

  /** Move the centre by metres of the plane. */
  #move(across, along) {
    if (this.viewport.zoom === 1) return;
    const [width, height] = this.projection.extent;
    this.viewport.across = Math.max(0, Math.min(1, this.viewport.across + across / width));
    this.viewport.along = Math.max(0, Math.min(1, this.viewport.along + along / height));
  }

  /** Move the image by CSS pixels. */
  drag(dx, dy) {
    if (!this.image) return;
    const g = this.#geometry();
    const [from, to] = [g.plane([0, 0]), g.plane([dx, dy])];
    this.#move(from[0] - to[0], from[1] - to[1]);
  }

  /** Move the view by fractions of the canvas. */
  pan(across, along) { this.drag(-across * this.canvas.clientWidth, -along * this.canvas.clientHeight); }

  draw() {
    const ratio = devicePixelRatio || 1;
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (width === 0 || height === 0) return;
    this.canvas.width = Math.round(width * ratio);
    this.canvas.height = Math.round(height * ratio);
    const context = this.canvas.getContext("2d");
    context.scale(ratio, ratio);
    if (!this.image) return;
    const style = getComputedStyle(this.canvas);
    const colour = { text: style.color, line: style.borderTopColor };
    context.font = `${Math.max(12, 0.78 * parseFloat(style.fontSize))}px ${style.fontFamily}`;
    this.projection.select(this.display, this.#room());
    const g = this.#geometry();
    this.#drawImage(context, g);
    drawAxes(context, this, g, colour);
    drawCaption(context, this, g, colour);
    const mark = drawMark(context, this, g);
    drawNorth(context, this, g);
    drawLines(context, this, g);
    if (this.crosshair) drawCrosshair(context, g.toCanvas(this.crosshair));
    this.#describe(mark, this.lines.filter((one) => one.outline).map((one) => g.toCanvas(one.from)));
  }

  /** What is drawn, for screen readers: axes, nadir and contact. */
  #describe(mark, outlines) {
    const axes = axesOf(this.projection);
    this.canvas.setAttribute("aria-description", [captionOf(this.projection), axes.across.name, axes.along.name, mark ? t("image.marked") : ""].filter(Boolean).join("; "));
    this.canvas.dataset.mark = mark ? JSON.stringify(mark) : "";
    this.canvas.dataset.outlines = JSON.stringify(outlines); // corners
    this.canvas.dataset.extent = JSON.stringify(this.projection.extent.map((metres) => Number(metres.toFixed(3))));
  }

  #drawImage(context, g) {
    context.save();
    g.clip(context);
    this.#paint(context, this.coloured, g);
    this.#drawHatch(context, g);
    context.restore();
  }

  /** Paint a canvas of the image's pixels in the projection. */
  #paint(context, pixels, g, smooth = this.smooth) {
    const [width, height] = this.projection.extent;
    const [a, b, c, d] = this.projection.matrix;
    const [x, y] = g.screen([0, 0]);
    context.save();
    context.transform(a * g.unit, b * g.unit, c * g.unit, d * g.unit, x, y);
    context.imageSmoothingEnabled = smooth;
    context.imageSmoothingQuality = "high";
    context.drawImage(pixels, 0, 0, width, height);
    context.restore();
  }

  /** Hatch missing areas, in screen pixels: the pattern does not change with the zoom. */
  #drawHatch(context, g) {
    if (!this.missing) return;
    const layer = new OffscreenCanvas(this.canvas.clientWidth, this.canvas.clientHeight);
    const paint = layer.getContext("2d");
    this.#paint(paint, this.missing, g, false);
    paint.globalCompositeOperation = "source-in";
    paint.fillStyle = hatchPattern(paint);
    paint.fillRect(0, 0, layer.width, layer.height);
    context.drawImage(layer, 0, 0);
  }

  /** Draw the surroundings of [row, column], enlarged, on another canvas, with measurements. */
  drawLoupe(canvas, point) {
    const ratio = devicePixelRatio || 1;
    const size = canvas.clientWidth;
    canvas.width = Math.round(size * ratio);
    canvas.height = canvas.width;
    const context = canvas.getContext("2d");
    const g = this.#geometry();
    const [x, y] = g.toCanvas(point);
    context.setTransform(ratio * LOUPE_ZOOM, 0, 0, ratio * LOUPE_ZOOM, canvas.width / 2 - ratio * LOUPE_ZOOM * x, canvas.height / 2 - ratio * LOUPE_ZOOM * y);
    this.#paint(context, this.coloured, g);
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    const enlarged = (one) => /** @type {Point} */ (g.toCanvas(one).map((value, axis) => size / 2 + LOUPE_ZOOM * (value - [x, y][axis])));
    for (const line of this.lines) drawLine(context, enlarged(line.from), enlarged(line.to), line.colour, !line.outline);
    drawCrosshair(context, [size / 2, size / 2]);
  }
}
