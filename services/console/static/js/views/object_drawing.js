// Drawing of looks: north-up, un-mirrored, in true metres; and the ring of aspects.

const radians = (degrees) => (degrees * Math.PI) / 180;

/**
 * Unit vectors [east, north] on the ground of an image's columns and rows; null if heading, side or pixel size is unknown.
 *
 * Row 0 is the first ping, and column 0 is nearest the track: rows run with the heading, columns away from the vehicle.
 */
export function groundAxes(look) {
  const { heading_deg, channel, pixel_along_m, pixel_across_m } = look;
  if (heading_deg === null || channel === null || !pixel_along_m || !pixel_across_m) return null;
  const heading = radians(heading_deg);
  const side = channel === "starboard" ? 1 : -1;
  return { rows: [Math.sin(heading), Math.cos(heading)], columns: [side * Math.cos(heading), -side * Math.sin(heading)] };
}

/** Side in metres of the smallest north-up square around an image. */
export function groundExtent(look, image) {
  const axes = groundAxes(look);
  if (!axes) return 0;
  const [along, across] = [image.height * look.pixel_along_m, image.width * look.pixel_across_m];
  return Math.max(...[0, 1].map((i) => Math.abs(axes.rows[i]) * along + Math.abs(axes.columns[i]) * across));
}

/** Length of a scale bar: 1, 2 or 5 times a power of ten, at most `limit_m`. */
export function barLength(limit_m) {
  const power = 10 ** Math.floor(Math.log10(limit_m));
  return [5, 2, 1].find((factor) => factor * power <= limit_m) * power;
}

function prepare(canvas) {
  const ratio = devicePixelRatio || 1;
  const { clientWidth: width, clientHeight: height } = canvas;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  const context = canvas.getContext("2d");
  context.scale(ratio, ratio);
  context.font = `600 12px ${getComputedStyle(canvas).fontFamily}`;
  return { context, width, height, ratio };
}

function label(context, text, x, y, align) {
  context.textAlign = align;
  context.lineWidth = 3;
  context.strokeStyle = "#000000";
  context.strokeText(text, x, y);
  context.fillStyle = "#ffffff";
  context.fillText(text, x, y);
}

/** Draw an image north-up. Without axes it is drawn as stored, fitted to the canvas. */
export function drawLook(canvas, look, image, coloured, pixelsPerMetre) {
  const { context, width, height } = prepare(canvas);
  context.fillStyle = "#000000";
  context.fillRect(0, 0, width, height);
  const axes = groundAxes(look);
  context.save();
  context.translate(width / 2, height / 2);
  if (axes) {
    const [across, along] = [look.pixel_across_m * pixelsPerMetre, look.pixel_along_m * pixelsPerMetre];
    // The y axis of the canvas points south.
    context.transform(axes.columns[0] * across, -axes.columns[1] * across, axes.rows[0] * along, -axes.rows[1] * along, 0, 0);
  } else {
    const scale = Math.min(width / image.width, height / image.height);
    context.scale(scale, scale);
  }
  context.drawImage(coloured, -image.width / 2, -image.height / 2);
  context.restore();
  if (!axes) return;
  drawSonar(context, radians(look.aspect_deg), width, height);
  label(context, "N", width - 12, 26, "center");
  context.fillStyle = "#ffffff";
  context.beginPath();
  context.moveTo(width - 12, 3);
  context.lineTo(width - 17, 14);
  context.lineTo(width - 7, 14);
  context.fill();
  const bar_m = barLength((0.4 * width) / pixelsPerMetre);
  context.fillRect(8, height - 10, bar_m * pixelsPerMetre, 3);
  label(context, `${bar_m} m`, 8, height - 14, "left");
}

/** Mark the bearing from which the sonar looked. */
function drawSonar(context, bearing, width, height) {
  const radius = Math.min(width, height) / 2 - 10;
  context.save();
  context.translate(width / 2 + radius * Math.sin(bearing), height / 2 - radius * Math.cos(bearing));
  context.rotate(bearing + Math.PI);
  context.beginPath();
  context.moveTo(0, -9);
  context.lineTo(6, 5);
  context.lineTo(-6, 5);
  context.closePath();
  context.fillStyle = "#ffcf4d";
  context.strokeStyle = "#000000";
  context.lineWidth = 2;
  context.stroke();
  context.fill();
  context.restore();
}

export const ASPECT_WIDTH = 20; // degrees of bearing that one look covers on the ring

/** Widest range of bearings without a look: [from, to] in degrees clockwise, or null without an aspect. */
export function widestGap(aspects) {
  const sorted = [...aspects].sort((a, b) => a - b);
  if (!sorted.length) return null;
  const gaps = sorted.map((from, i) => [from, sorted[i + 1] ?? sorted[0] + 360]);
  const [from, to] = gaps.reduce((best, gap) => (gap[1] - gap[0] > best[1] - best[0] ? gap : best));
  const half = ASPECT_WIDTH / 2;
  return to - from <= ASPECT_WIDTH ? null : [(from + half) % 360, (to - half + 360) % 360];
}

/** Draw the bearings from which an object was seen. */
export function drawRing(canvas, aspects, colour) {
  const { context, width, height } = prepare(canvas);
  const radius = Math.min(width, height) / 2 - 16;
  context.translate(width / 2, height / 2);
  context.strokeStyle = colour("line");
  context.lineWidth = 2;
  context.beginPath();
  context.arc(0, 0, radius, 0, 2 * Math.PI);
  context.stroke();
  context.strokeStyle = colour("accent");
  context.lineWidth = 9;
  for (const aspect of aspects) {
    const [from, to] = [aspect - ASPECT_WIDTH / 2 - 90, aspect + ASPECT_WIDTH / 2 - 90].map(radians);
    context.beginPath();
    context.arc(0, 0, radius, from, to);
    context.stroke();
  }
  context.fillStyle = colour("text");
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillText("N", 0, -radius - 9);
  context.beginPath();
  context.arc(0, 0, 3, 0, 2 * Math.PI);
  context.fill();
}
