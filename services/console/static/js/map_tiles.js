// Offline tiles below the map, where a folder of them is configured: web-Mercator tiles, placed in local metres.

import { state } from "./state.js";

const EARTH_M = 6378137;
const MOST = 120;
const RADIANS = Math.PI / 180;

const column = (lon_deg, zoom) => ((lon_deg + 180) / 360) * 2 ** zoom;
const row = (lat_deg, zoom) => ((1 - Math.asinh(Math.tan(lat_deg * RADIANS)) / Math.PI) / 2) * 2 ** zoom;
const longitude = (x, zoom) => (x / 2 ** zoom) * 360 - 180;
const latitude = (y, zoom) => Math.atan(Math.sinh(Math.PI * (1 - (2 * y) / 2 ** zoom))) / RADIANS;

export class MapTiles {
  constructor(arrived) {
    this.arrived = arrived;
    this.images = new Map();
  }

  #image(z, x, y) {
    const url = state.info.tiles.url.replace("{z}", z).replace("{x}", x).replace("{y}", y);
    if (!this.images.has(url)) {
      if (this.images.size > MOST) this.images.delete(this.images.keys().next().value);
      const image = new Image();
      image.onload = this.arrived;
      image.src = url;
      this.images.set(url, image);
    }
    return this.images.get(url);
  }

  draw({ context, width, height, toScreen, perMetre, centre }, origin) {
    if (!state.info.tiles || !origin) return;
    const degree_m = EARTH_M * RADIANS;
    const shrink = Math.cos(origin.lat_deg * RADIANS);
    const at = (x_m, y_m) => ({ lon: origin.lon_deg + x_m / degree_m / shrink, lat: origin.lat_deg + y_m / degree_m });
    const wanted = Math.round(Math.log2((perMetre * 2 * Math.PI * EARTH_M * shrink) / 256));
    const zoom = Math.max(state.info.tiles.min_zoom, Math.min(state.info.tiles.max_zoom, wanted));
    const half = { x: width / 2 / perMetre, y: height / 2 / perMetre };
    const [low, high] = [at(centre.x - half.x, centre.y - half.y), at(centre.x + half.x, centre.y + half.y)];
    const [left, right, top, bottom] = [column(low.lon, zoom), column(high.lon, zoom), row(high.lat, zoom), row(low.lat, zoom)].map(Math.floor);
    if ((right - left + 1) * (bottom - top + 1) > MOST) return;
    const corner = (x, y) => toScreen((longitude(x, zoom) - origin.lon_deg) * degree_m * shrink, (latitude(y, zoom) - origin.lat_deg) * degree_m);
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
