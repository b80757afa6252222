// What is drawn over an image: axes, grid, mark of the contact, north arrow, measurements.

import { niceStep } from "../base/format.js";
import { t } from "../texts.js";

export const MARGIN = { left: 58, top: 24, right: 12, bottom: 40 };
const MARK_COLOUR = "#ff4dd8";
const PROFILE_PX = 34;

const digitsOf = (step) => Math.max(0, -Math.floor(Math.log10(step) + 1e-9));

/** Multiples of a step within [first, last]. */
function ticks(first, last, step) {
  const found = [];
  for (let n = Math.ceil(first / step - 1e-9); n * step <= last + 1e-9; n += 1) found.push(n * step);
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
  const error = rangeError >= 0.05 ? ` (± ${rangeError.toFixed(1)})` : "";
  const across = !scale ? t("image.across_px") : first === null ? t("image.across_m")
    : (ground || range_axis === "ground" ? t("image.ground_range") : range_axis === "slant" ? t("image.slant_range") : t("image.unknown_range")) + error;
  const along = !scale ? t("image.along_px") : mark ? t("image.along_contact") : t("image.along_m");
  return { across: { name: across, first: first ?? 0 }, along: { name: along, first: mark && scale ? -mark.row * projection.along : 0 } };
}

/** Draw the frame, axes and grid. `g` is the geometry of the view. */
export function drawAxes(context, view, g, colour) {
  const { projection } = view;
  const [right, bottom] = [MARGIN.left + g.box.width, MARGIN.top + g.box.height];
  const axes = axesOf(projection);
  const stepOf = (extent, spacing_px, limit_px) => {
    const length_px = Math.min(extent * g.unit, limit_px);
    return niceStep(length_px / g.unit, Math.max(1, length_px / spacing_px));
  };
  const steps = { across: stepOf(projection.extent[0], 45, g.box.width), along: stepOf(projection.extent[1], 45, g.box.height) };
  context.strokeStyle = colour.line;
  context.lineWidth = 1;
  context.strokeRect(MARGIN.left - 0.5, MARGIN.top - 0.5, g.box.width + 1, g.box.height + 1);
  const values = {
    across: ticks(axes.across.first, axes.across.first + projection.extent[0], steps.across),
    along: ticks(axes.along.first, axes.along.first + projection.extent[1], steps.along),
  };
  if (view.display.grid) drawGrid(context, view, g, axes, values);
  context.fillStyle = colour.text;
  if (projection.orientation === "north") {
    drawScaleBar(context, g, right, bottom, projection.scale ? "m" : "px");
    return;
  }
  context.textAlign = "center";
  context.textBaseline = "top";
  for (const value of values.across) {
    const [x] = g.screen([value - axes.across.first, 0]);
    if (x < MARGIN.left - 0.5 || x > right + 0.5) continue;
    context.fillRect(x - 0.5, bottom, 1, 5);
    context.fillText(value.toFixed(digitsOf(steps.across)), x, bottom + 6);
  }
  context.fillText(axes.across.name, (MARGIN.left + right) / 2, bottom + 22);
  context.textAlign = "right";
  context.textBaseline = "middle";
  for (const value of values.along) {
    const [, y] = g.screen([0, value - axes.along.first]);
    if (y < MARGIN.top - 0.5 || y > bottom + 0.5) continue;
    context.fillRect(MARGIN.left - 6, y - 0.5, 5, 1);
    context.fillText(`${axes.along.first < 0 && value > steps.along / 2 ? "+" : ""}${value.toFixed(digitsOf(steps.along)).replace("-", "−")}`, MARGIN.left - 9, y);
  }
  context.save();
  context.translate(10, (MARGIN.top + bottom) / 2);
  context.rotate(-Math.PI / 2);
  context.textAlign = "center";
  context.fillText(axes.along.name, 0, 0);
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
  context.fillText(`${metres} ${unit}`, right - length - 8, bottom + 12);
}

/** Draw side, nadir and title above the image. */
export function drawCaption(context, view, g, colour) {
  const { projection } = view;
  const { orientation, side } = projection;
  const right = MARGIN.left + g.box.width;
  const y = MARGIN.top - 12;
  context.fillStyle = colour.text;
  context.textBaseline = "middle";
  context.textAlign = "left";
  const caption = captionOf(projection);
  context.fillText(caption, MARGIN.left, y);
  const atRight = orientation === "above" && side === "port";
  const title = `${view.title}${atRight ? ` · ${t("image.nadir_right")}` : ""}`;
  context.textAlign = "right";
  const available = g.box.width - context.measureText(caption).width - 12;
  const short = title.split(" · ").slice(atRight ? -1 : 0)[0];
  const text = [title, short].find((one) => context.measureText(one).width < available);
  if (text) context.fillText(text, right, y);
}

/** Statement about nadir, side and handedness of the view. */
export function captionOf({ orientation, side }) {
  if (side === null) return t("image.side_unknown");
  if (orientation === "north") return t("image.north_up", { side: t(`image.${side}`) });
  if (orientation === "above") return `${side === "starboard" ? `${t("image.nadir_left")} · ` : ""}${t("image.above", { side: t(`image.${side}`) })}`;
  return `${t("image.nadir_left")} · ${t(`image.${side}_nadir`)}`;
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
  const [x, y] = [MARGIN.left + g.box.width - 28, MARGIN.top + 28];
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
  drawLabel(context, t("image.heading", { degrees: heading_deg.toFixed(0) }), x - 34, y + 38, "#ffffff");
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
  const right = MARGIN.left + g.box.width;
  const used = [];
  for (const line of view.lines) {
    const [from, to] = [g.toCanvas(line.from), g.toCanvas(line.to)];
    drawLine(context, from, to, line.colour, !line.outline);
    if (line.profile) drawProfile(context, view, g, line, from, to);
    if (!line.label) continue;
    const anchor = from[0] > to[0] ? from : to;
    const width = context.measureText(line.label).width + 10;
    let y = Math.max(MARGIN.top + 92, Math.min(MARGIN.top + g.box.height - 14, anchor[1] - 30));
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
function drawProfile(context, view, g, line, from, to) {
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
