// Drawing of the map in local metres, x east and y north: tiles, grid, scale, north arrow, rings, tracks, contacts.

import { niceStep, symbol } from "./format.js";
import { state } from "./state.js";

const TONES = { mine_like: "mine", not_mine_like: "not", unsure: "unsure", disputed: "mine", unreviewed: "accent" };
const metresText = (value) => (value >= 1000 ? `${value / 1000} km` : `${value} m`);

/** Text with an outline, legible on every background. */
function drawText(context, text, x, y, colour, outline) {
  context.lineWidth = 4;
  context.lineJoin = "round";
  context.strokeStyle = outline;
  context.strokeText(text, x, y);
  context.fillStyle = colour;
  context.fillText(text, x, y);
}

export function drawFrame(stage, { ring_m: rings, vessel }) {
  const { context, width, height, toScreen, pixelsPerMetre, colour, centre } = stage;
  const step = niceStep(width / pixelsPerMetre, width / 110);
  const line = () => {
    context.strokeStyle = colour("grid");
    context.lineWidth = 1;
    context.stroke();
  };
  context.textAlign = "left";
  context.textBaseline = "top";
  const west = centre.x - width / 2 / pixelsPerMetre;
  const south = centre.y - height / 2 / pixelsPerMetre;
  const label = (value) => (step < 1 ? value.toFixed(1) : String(Math.round(value)));
  for (let x = Math.ceil(west / step) * step; x < west + width / pixelsPerMetre; x += step) {
    const [at] = toScreen(x, 0);
    context.beginPath();
    context.moveTo(at, 0);
    context.lineTo(at, height);
    line();
    drawText(context, label(x), at + 3, height - 18, colour("muted"), colour("water"));
  }
  for (let y = Math.ceil(south / step) * step; y < south + height / pixelsPerMetre; y += step) {
    const [, at] = toScreen(0, y);
    context.beginPath();
    context.moveTo(0, at);
    context.lineTo(width, at);
    line();
    drawText(context, label(y), 4, at + 2, colour("muted"), colour("water"));
  }
  const [x, y] = toScreen(vessel?.x_m ?? 0, vessel?.y_m ?? 0);
  for (const radius of rings) {
    context.strokeStyle = colour("muted");
    context.lineWidth = 1.3;
    context.setLineDash([7, 6]);
    context.beginPath();
    context.arc(x, y, radius * pixelsPerMetre, 0, 2 * Math.PI);
    context.stroke();
    context.setLineDash([]);
    context.textAlign = "center";
    drawText(context, metresText(radius), x, y - radius * pixelsPerMetre + 3, colour("muted"), colour("water"));
  }
  context.textAlign = "left";
  if (vessel) {
    context.fillStyle = colour("text");
    context.fillRect(x - 6, y - 6, 12, 12);
    drawText(context, "vessel", x + 10, y - 8, colour("text"), colour("water"));
  }
  drawScale(stage);
  drawNorth(stage);
}

function drawScale({ context, width, height, pixelsPerMetre, colour }) {
  const metres = niceStep(width / pixelsPerMetre, 7);
  const [x, y, length] = [width - metres * pixelsPerMetre - 24, height - 46, metres * pixelsPerMetre];
  context.fillStyle = colour("bg");
  context.globalAlpha = 0.85;
  context.fillRect(x - 12, y - 24, length + 24, 40);
  context.globalAlpha = 1;
  context.strokeStyle = colour("text");
  context.lineWidth = 2;
  context.beginPath();
  context.moveTo(x, y - 5);
  context.lineTo(x, y + 5);
  context.moveTo(x, y);
  context.lineTo(x + length, y);
  context.moveTo(x + length, y - 5);
  context.lineTo(x + length, y + 5);
  context.stroke();
  context.fillStyle = colour("text");
  context.textAlign = "center";
  context.textBaseline = "bottom";
  context.fillText(metresText(metres), x + length / 2, y - 3);
}

function drawNorth({ context, width, colour }) {
  const x = width - 34;
  context.fillStyle = colour("text");
  context.beginPath();
  context.moveTo(x, 14);
  context.lineTo(x + 9, 42);
  context.lineTo(x, 35);
  context.lineTo(x - 9, 42);
  context.fill();
  context.textAlign = "center";
  context.textBaseline = "top";
  drawText(context, "N", x, 45, colour("text"), colour("water"));
}

export function drawTracks({ context, toScreen, colour }, { vehicles }) {
  for (const { vehicle_id: name, track, stale } of vehicles) {
    if (!track.length) continue;
    const points = track.map(([x, y]) => toScreen(x, y));
    context.strokeStyle = colour(stale ? "stale" : "accent");
    context.lineWidth = 2;
    context.setLineDash(stale ? [4, 5] : []);
    context.beginPath();
    points.forEach(([x, y], index) => (index ? context.lineTo(x, y) : context.moveTo(x, y)));
    context.stroke();
    context.setLineDash([]);
    const [x, y] = points.at(-1);
    context.fillStyle = colour(stale ? "stale" : "accent");
    context.beginPath();
    context.arc(x, y, 6, 0, 2 * Math.PI);
    context.fill();
    context.textAlign = "left";
    context.textBaseline = "middle";
    drawText(context, stale ? `${name} (stale)` : name, x + 10, y + 14, colour(stale ? "stale" : "text"), colour("water"));
  }
}

export function drawContacts({ context, width, height, toScreen, pixelsPerMetre, colour }, contacts, chosen) {
  const withNames = contacts.length <= 60 || pixelsPerMetre > 2;
  context.textBaseline = "middle";
  for (const one of contacts) {
    const [x, y] = toScreen(one.x_m, one.y_m);
    if (x < -20 || y < -20 || x > width + 20 || y > height + 20) continue;
    const tone = colour(TONES[one.review] ?? "accent");
    if (one.sigma_m && one.sigma_m * pixelsPerMetre > 8) {
      context.strokeStyle = tone;
      context.lineWidth = 1;
      context.beginPath();
      context.arc(x, y, one.sigma_m * pixelsPerMetre, 0, 2 * Math.PI);
      context.stroke();
    }
    if (one.atd_class === "structure") {
      context.strokeStyle = tone;
      context.lineWidth = 1.5;
      context.strokeRect(x - 9, y - 9, 18, 18);
    }
    context.textAlign = "center";
    drawText(context, symbol(one.review), x, y, tone, colour("bg"));
    if (one.id === chosen) {
      context.strokeStyle = colour("focus");
      context.lineWidth = 3;
      context.strokeRect(x - 13, y - 13, 26, 26);
    }
    context.textAlign = "left";
    if (withNames || one.id === chosen) drawText(context, one.name.split("/").at(-1), x + 14, y, colour("text"), colour("water"));
  }
}

/** The contact nearest to a point of the screen, within 16 px; null if there is none. */
export function nearest(contacts, toScreen, x, y) {
  let best = null;
  let least = 16;
  for (const one of contacts) {
    const [cx, cy] = toScreen(one.x_m, one.y_m);
    const distance = Math.hypot(cx - x, cy - y);
    if (distance < least) [best, least] = [one, distance];
  }
  return best;
}

// Tiles below the map: web-Mercator tiles, if a folder is configured, placed in local metres.

const EARTH_M = 6378137;
const MAX_TILES = 120;
const RADIANS = Math.PI / 180;

const column = (lon_deg, zoom) => ((lon_deg + 180) / 360) * 2 ** zoom;
const row = (lat_deg, zoom) => ((1 - Math.asinh(Math.tan(lat_deg * RADIANS)) / Math.PI) / 2) * 2 ** zoom;
const longitude = (x, zoom) => (x / 2 ** zoom) * 360 - 180;
const latitude = (y, zoom) => Math.atan(Math.sinh(Math.PI * (1 - (2 * y) / 2 ** zoom))) / RADIANS;

export class MapTiles {
  constructor(onLoad) {
    this.onLoad = onLoad;
    this.images = new Map();
  }

  #image(z, x, y) {
    const url = state.info.tiles.url.replace("{z}", z).replace("{x}", x).replace("{y}", y);
    if (!this.images.has(url)) {
      if (this.images.size > MAX_TILES) this.images.delete(this.images.keys().next().value);
      const image = new Image();
      image.onload = this.onLoad;
      image.src = url;
      this.images.set(url, image);
    }
    return this.images.get(url);
  }

  draw({ context, width, height, toScreen, pixelsPerMetre, centre }, origin) {
    if (!state.info.tiles || !origin) return;
    const degree_m = EARTH_M * RADIANS;
    const lonScale = Math.cos(origin.lat_deg * RADIANS);
    const toDegrees = (x_m, y_m) => ({ lon: origin.lon_deg + x_m / degree_m / lonScale, lat: origin.lat_deg + y_m / degree_m });
    const bestZoom = Math.round(Math.log2((pixelsPerMetre * 2 * Math.PI * EARTH_M * lonScale) / 256));
    const zoom = Math.max(state.info.tiles.min_zoom, Math.min(state.info.tiles.max_zoom, bestZoom));
    const half = { x: width / 2 / pixelsPerMetre, y: height / 2 / pixelsPerMetre };
    const [low, high] = [toDegrees(centre.x - half.x, centre.y - half.y), toDegrees(centre.x + half.x, centre.y + half.y)];
    const [left, right, top, bottom] = [column(low.lon, zoom), column(high.lon, zoom), row(high.lat, zoom), row(low.lat, zoom)].map(Math.floor);
    if ((right - left + 1) * (bottom - top + 1) > MAX_TILES) return;
    const corner = (x, y) => toScreen((longitude(x, zoom) - origin.lon_deg) * degree_m * lonScale, (latitude(y, zoom) - origin.lat_deg) * degree_m);
    for (let x = left; x <= right; x += 1) {
      for (let y = top; y <= bottom; y += 1) {
        const image = this.#image(zoom, x, y);
        if (!image.complete || !image.naturalWidth) continue;
        const [[x0, y0], [x1, y1]] = [corner(x, y), corner(x + 1, y + 1)];
        context.drawImage(image, x0, y0, x1 - x0, y1 - y0);
      }
    }
  }
}
