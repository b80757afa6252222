// What is drawn over an image: axes, grid, mark of the contact, north arrow, measurements.

import { niceStep, number } from "../base/format.js";
import { t } from "../texts.js";

export const MARGIN = { left: 54, top: 17, right: 10, bottom: 19 };
const MARK_COLOUR = "#ff4dd8";
const PROFILE_PX = 34;

const digitsOf = (step) => Math.max(0, -Math.floor(Math.log10(step) + 1e-9));

/** Multiples of a step within [first, last]. */
function ticks(first, last, step) {
  const found = [];
  for (let n = Math.ceil(first / step - 1e-9); n * step <= last + 1e-9; n += 1) found.push(n * step + 0); // no negative zero
  return found;
}

/** Draw strokes twice, so that they are visible on bright and dark seabed. */
function outlined(context, colour, width, path) {
  for (const [style, line] of [["#000000", width + 2.4], [colour, width]]) {
    context.strokeStyle = style;
    context.lineWidth = line;
    context.beginPath();
    path();
    context.stroke();
  }
}

/** Axes of a view: range across the track, distance along the track from the contact, and their names. */
export function axesOf(projection) {
  const { scale, mark, ground, range_axis, rangeError } = projection;
  const first = projection.firstRange;
  const error = rangeError >= 0.05 ? ` (± ${number(rangeError, 1)})` : "";
  const across = !scale ? t("image.across_px") : first === null ? t("image.across_m")
    : (ground || range_axis === "ground" ? t("image.ground_range") : range_axis === "slant" ? t("image.slant_range") : t("image.unknown_range")) + error;
  const along = !scale ? t("image.along_px") : mark ? t("image.along_contact") : t("image.along_m");
  return { across: { name: across, first: first ?? 0 }, along: { name: along, first: mark && scale ? -mark.row * projection.along : 0 } };
}

/** Draw the frame, axes and grid. `g` is the geometry of the view. */
export function drawAxes(context, view, g, colour) {
  const { projection } = view;
  const { left, top } = g.box;
  const [right, bottom] = [left + g.box.width, top + g.box.height];
  const axes = axesOf(projection);
  const [horizontal, vertical] = projection.turned ? ["along", "across"] : ["across", "along"];
  const steps = {};
  const values = {};
  for (const [axis, extent, limit_px] of [["across", projection.extent[0]], ["along", projection.extent[1]]].map((one) => [...one, one[0] === horizontal ? g.box.width : g.box.height])) {
    const length_px = Math.min(extent * g.unit, limit_px);
    steps[axis] = niceStep(length_px / g.unit, Math.max(1, length_px / 45));
    values[axis] = ticks(axes[axis].first, axes[axis].first + extent, steps[axis]);
  }
  /** Point of the screen where a value of an axis is at the side of the image. */
  const at = (axis, value) => g.screen(axis === "across" ? [value - axes.across.first, 0] : [0, value - axes.along.first]);
  const text = (axis, value) => `${axes[axis].first < 0 && value > steps[axis] / 2 ? "+" : ""}${number(value, digitsOf(steps[axis])).replace("-", "−")}`;
  context.strokeStyle = colour.line;
  context.lineWidth = 1;
  context.strokeRect(left - 0.5, top - 0.5, g.box.width + 1, g.box.height + 1);
  if (view.display.grid) drawGrid(context, view, g, axes, values);
  context.fillStyle = colour.text;
  if (projection.orientation === "north") {
    drawScaleBar(context, g, right, bottom, projection.scale ? "m" : "px");
    return;
  }
  // The name of the horizontal axis is at the end of its line.
  context.textAlign = "right";
  context.textBaseline = "top";
  const name = axes[horizontal].name;
  context.fillText(name, right, bottom + 4);
  const last = right - context.measureText(name).width - 16;
  context.textAlign = "center";
  for (const value of values[horizontal]) {
    const [x] = at(horizontal, value);
    if (x < left - 0.5 || x > right + 0.5) continue;
    context.fillRect(x - 0.5, bottom, 1, 5);
    if (x < last) context.fillText(text(horizontal, value), x, bottom + 4);
  }
  context.textAlign = "right";
  context.textBaseline = "middle";
  for (const value of values[vertical]) {
    const [, y] = at(vertical, value);
    if (y < top - 0.5 || y > bottom + 0.5) continue;
    context.fillRect(left - 6, y - 0.5, 5, 1);
    context.fillText(text(vertical, value), left - 8, y);
  }
  context.save();
  context.translate(left - MARGIN.left + 9, (top + bottom) / 2);
  context.rotate(-Math.PI / 2);
  context.textAlign = "center";
  context.fillText(axes[vertical].name, 0, 0);
  context.restore();
}

function drawGrid(context, view, g, axes, values) {
  const [width, height] = view.projection.extent;
  context.save();
  g.clip(context);
  context.strokeStyle = "#ffffff3c";
  context.lineWidth = 1;
  context.beginPath();
  const line = (from, to) => { context.moveTo(...g.screen(from)); context.lineTo(...g.screen(to)); };
  for (const value of values.across) line([value - axes.across.first, 0], [value - axes.across.first, height]);
  for (const value of values.along) line([0, value - axes.along.first], [width, value - axes.along.first]);
  context.stroke();
  context.restore();
}

function drawScaleBar(context, g, right, bottom, unit) {
  const metres = niceStep(g.box.width / g.unit, 6);
  const length = metres * g.unit;
  context.fillRect(right - length, bottom + 10, length, 3);
  for (const x of [right - length, right - 1]) context.fillRect(x, bottom + 6, 1.5, 11);
  context.textAlign = "right";
  context.textBaseline = "middle";
  context.fillText(`${number(metres, digitsOf(metres))} ${unit}`, right - length - 8, bottom + 12);
}

/** Draw side, nadir and title above the image. */
export function drawCaption(context, view, g, colour) {
  const y = g.box.top - 9;
  context.fillStyle = colour.text;
  context.textBaseline = "middle";
  context.textAlign = "left";
  const caption = captionOf(view.projection);
  context.fillText(caption, g.box.left, y);
  context.textAlign = "right";
  const available = g.box.width - context.measureText(caption).width - 12;
  const text = [view.title, view.title.split(" · ")[0]].find((one) => context.measureText(one).width < available);
  if (text) context.fillText(text, g.box.left + g.box.width, y);
}

/** Statement about nadir, side and handedness of the view. */
export function captionOf(/** @type {import("./image_projection.js").Projection} */ { orientation, side, turned, matrix: [x, y] }) {
  if (side === null) return t("image.side_unknown");
  const name = t(`image.${side}`);
  if (orientation === "north") return t("image.north_up", { side: name });
  const arrow = turned ? (y > 0 ? "▲" : "▼") : x > 0 ? "◀" : "▶";
  const view = orientation === "above" ? t("image.above", { side: name }) : side === "starboard" ? t("image.starboard_nadir") : t("image.port_nadir", { degrees: turned ? 270 : 180 });
  return `${t("image.nadir", { arrow })} · ${view}`;
}

/** Draw corners around the area of the contact, and ticks at its row; return the corners on the screen. */
export function drawMark(context, view, g) {
  const { box, mark } = view.projection;
  if (!box || !mark) return null;
  const corners = [[box.rows[0], box.columns[0]], [box.rows[0], box.columns[1]], [box.rows[1], box.columns[1]], [box.rows[1], box.columns[0]]].map((point) => g.toCanvas(point));
  context.save();
  g.clip(context);
  outlined(context, MARK_COLOUR, 1.6, () => {
    corners.forEach(([x, y], i) => {
      for (const [nx, ny] of [corners[(i + 1) % 4], corners[(i + 3) % 4]]) {
        const length = Math.hypot(nx - x, ny - y) || 1;
        const part = Math.min(12, length / 3) / length;
        context.moveTo(x, y);
        context.lineTo(x + (nx - x) * part, y + (ny - y) * part);
      }
    });
    // Ticks outside the box: the row of the contact, and its possible columns.
    const tick = (from, to) => {
      const [x0, y0] = g.toCanvas(from);
      const [x1, y1] = g.toCanvas(to);
      const length = Math.hypot(x1 - x0, y1 - y0) || 1;
      context.moveTo(x0, y0);
      context.lineTo(x0 + ((x0 - x1) / length) * 9, y0 + ((y0 - y1) / length) * 9);
    };
    tick([mark.row, box.columns[0]], [mark.row, box.columns[1]]);
    tick([mark.row, box.columns[1]], [mark.row, box.columns[0]]);
    for (const column of mark.columns) {
      tick([box.rows[0], column], [box.rows[1], column]);
      tick([box.rows[1], column], [box.rows[0], column]);
    }
  });
  context.restore();
  return corners.map((point) => point.map((value) => Math.round(value)));
}

/** Draw the direction of north, and the heading. */
export function drawNorth(context, view, g) {
  const { north, heading_deg } = view.projection;
  if (north === null) return;
  const [x, y] = [g.box.left + g.box.width - 28, g.box.top + 28];
  const tip = (factor) => [x + north[0] * factor, y + north[1] * factor];
  context.fillStyle = "#000000a0";
  context.beginPath();
  context.arc(x, y, 25, 0, 2 * Math.PI);
  context.fill();
  outlined(context, "#ffffff", 1.8, () => {
    context.moveTo(...tip(-17));
    context.lineTo(...tip(7));
    for (const side of [-1, 1]) {
      context.moveTo(...tip(7));
      context.lineTo(x - side * north[1] * 5, y + side * north[0] * 5);
    }
  });
  context.fillStyle = "#ffffff";
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillText(t("image.north"), ...tip(17));
  drawLabel(context, t("image.heading", { degrees: number(heading_deg) }), x - 34, y + 38, "#ffffff");
}

export function drawLabel(context, text, x, y, colour) {
  context.textAlign = "center";
  context.textBaseline = "middle";
  const width = context.measureText(text).width + 10;
  context.fillStyle = "#000000d0";
  context.fillRect(x - width / 2, y - 10, width, 20);
  context.fillStyle = colour;
  context.fillText(text, x, y);
}

/** Draw measurements. Their labels are at the side of the image away from the nadir. */
export function drawLines(context, view, g) {
  const right = g.box.left + g.box.width;
  const used = [];
  for (const line of view.lines) {
    const [from, to] = [g.toCanvas(line.from), g.toCanvas(line.to)];
    drawLine(context, from, to, line.colour, !line.outline);
    if (line.profile) drawProfile(context, view, line, from, to);
    if (!line.label) continue;
    const anchor = from[0] > to[0] ? from : to;
    const width = context.measureText(line.label).width + 10;
    let y = Math.max(g.box.top + 92, Math.min(g.box.top + g.box.height - 14, anchor[1] - 30));
    while (used.some((other) => Math.abs(other - y) < 22)) y += 22;
    used.push(y);
    const x = right - width / 2 - 4;
    context.strokeStyle = line.colour;
    context.lineWidth = 1;
    context.setLineDash([3, 4]);
    context.beginPath();
    context.moveTo(...anchor);
    context.lineTo(Math.max(anchor[0], x - width / 2), y);
    context.stroke();
    context.setLineDash([]);
    drawLabel(context, line.label, x, y, line.colour);
  }
}

/** Draw a line, with marks at its ends unless it is part of an outline. */
export function drawLine(context, [x0, y0], [x1, y1], colour, marked = true) {
  const length = Math.hypot(x1 - x0, y1 - y0) || 1;
  const [tx, ty] = [(-(y1 - y0) / length) * 7, ((x1 - x0) / length) * 7];
  outlined(context, colour, 2, () => {
    context.moveTo(x0, y0);
    context.lineTo(x1, y1);
    for (const [x, y] of marked ? [[x0, y0], [x1, y1]] : []) { context.moveTo(x - tx, y - ty); context.lineTo(x + tx, y + ty); }
  });
}

/** Draw the grey levels along a line across the track beside it, as a mean of five rows. */
function drawProfile(context, view, line, from, to) {
  const { image } = view;
  const levels = profileOf(image, line.from[0], line.from[1], line.to[1]);
  const length = Math.hypot(to[0] - from[0], to[1] - from[1]);
  if (length < 8 || levels.length < 2) return;
  // Perpendicular to the line, to the side of later rows.
  const [nx, ny] = [-(to[1] - from[1]) / length, (to[0] - from[0]) / length];
  const sign = line.to[1] < line.from[1] ? -1 : 1;
  const at = (part, height) => [
    from[0] + part * (to[0] - from[0]) + sign * nx * (12 + PROFILE_PX - height), from[1] + part * (to[1] - from[1]) + sign * ny * (12 + PROFILE_PX - height)];
  context.fillStyle = "#000000b0";
  context.beginPath();
  for (const [index, point] of [at(0, PROFILE_PX), at(1, PROFILE_PX), at(1, 0), at(0, 0)].entries()) context[index ? "lineTo" : "moveTo"](...point);
  context.fill();
  context.strokeStyle = line.colour;
  context.lineWidth = 1.4;
  context.beginPath();
  levels.forEach((level, i) => context[i ? "lineTo" : "moveTo"](...at(i / (levels.length - 1), (level / 255) * PROFILE_PX)));
  context.stroke();
}

/** Mean grey levels of five rows from one column to another. */
export function profileOf(image, row, column, endColumn) {
  const count = Math.max(2, Math.ceil(Math.abs(endColumn - column)));
  const rows = [-2, -1, 0, 1, 2].map((step) => Math.floor(row) + step).filter((one) => one >= 0 && one < image.height);
  return Array.from({ length: count }, (_, i) => {
    const x = Math.max(0, Math.min(image.width - 1, Math.floor(column + ((i + 0.5) / count) * (endColumn - column))));
    return rows.reduce((sum, y) => sum + image.levels[y * image.width + x], 0) / rows.length;
  });
}

export function drawCrosshair(context, [x, y]) {
  outlined(context, "#ffffff", 1.5, () => {
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      context.moveTo(x + 4 * dx, y + 4 * dy);
      context.lineTo(x + 16 * dx, y + 16 * dy);
    }
  });
}
