// Layers of the map: tiles, frame, range rings, vehicles, surveyed area, and contacts with their clusters.

import { age, isStale } from "../base/ages.js";
import { h } from "../base/dom.js";
import { latitude, longitude, number, quantity, symbol, verdict } from "../base/format.js";
import { circle, clusters, frameLines, metresPerDegree, nearLongitude } from "./map_geometry.js";
import { state } from "../base/state.js";
import { t } from "../texts.js";

const CLUSTER_PX = 30;
const NAMED_SYMBOLS = 60; // above this number only the selected contact has its name
const CIRCLE_PX = 16; // a smaller position circle is hidden by the symbol
const LINE_PX = 130; // distance of the frame's lines
const LETTER_PX = 7.5; // mean width of a letter of a vehicle's label
const [SYMBOL_PX, HEIGHT_PX, NAME_PX] = [18, 22, 60]; // half width of a symbol, height of a label, width of a symbol with its name
const TILE_PX = 256;

export const rangeText = (range_m) => (range_m >= 1000 ? `${number(range_m / 1000, 0, { maximumFractionDigits: 2 })}\u202fkm` : quantity(range_m, "m", 0));
export const latLng = (one) => [one.lat_deg, one.lon_deg];

export class MapLayers {
  /** `L`: Leaflet; `select(contacts)` is called with the contacts of a symbol that was clicked. */
  constructor(L, map, select) {
    this.L = L;
    this.map = map;
    this.select = select;
    this.frame = L.layerGroup().addTo(map);
    this.ground = L.layerGroup().addTo(map);
    this.vehicles = L.layerGroup().addTo(map);
    this.contacts = L.layerGroup().addTo(map);
    /** @type {{x: number, y: number, half_px: number}[]} */
    this.symbols = []; // places of the contacts' symbols, in pixels
    const { tiles } = state.info;
    if (tiles) L.tileLayer(tiles.url, { minZoom: tiles.min_zoom, maxNativeZoom: tiles.max_zoom, maxZoom: map.getMaxZoom() }).addTo(map);
  }

  /** Draw all layers but the vehicles. `contacts` are all contacts, `chosen` is the identifier of the selected one. */
  draw({ contacts, tracks, swaths, vessel, ring_m }, chosen) {
    const bounds = this.map.getBounds();
    this.#drawFrame(bounds);
    this.ground.clearLayers();
    this.contacts.clearLayers();
    const wide = bounds.pad(0.3);
    const inside = contacts.filter((one) => wide.contains(latLng(one)));
    if (swaths.length) this.ground.addLayer(this.#shape(swaths, "swath"));
    if (vessel) this.#drawVessel(vessel, ring_m);
    for (const track of tracks) this.ground.addLayer(this.#shape(track.points, "track", false));
    this.#drawContacts(inside, chosen);
  }

  /** Draw the vehicles of the fleet that have a position, and their measured distances from the vessel. */
  drawVehicles(vehicles, vessel) {
    this.vehicles.clearLayers();
    const placed = vehicles.filter((one) => one.lat_deg !== null);
    const taken = [...this.symbols, ...placed.map((one) => ({ ...this.#pixel(one), half_px: SYMBOL_PX }))];
    for (const one of vehicles) {
      if (vessel && one.measured_range) this.#drawRange(vessel, one.vehicle_id, one.measured_range);
    }
    for (const one of placed) this.#drawVehicle(one, taken);
  }

  /**
   * Label of a vehicle, at the first of the places around its symbol that is free and on the map.
   * @param {any} one vehicle
   * @param {string[]} texts label, and a shorter one for the case that no place is free
   * @param {{x: number, y: number, half_px: number}[]} taken symbols and labels; the label is added
   */
  #label(one, texts, taken) {
    const { x, y } = this.#pixel(one);
    const left_px = this.map.latLngToContainerPoint(latLng(one)).x;
    const places = texts.flatMap((text) => {
      const half_px = LETTER_PX * text.length / 2;
      return [[0, 28], [0, -28], [SYMBOL_PX + half_px, 0], [-SYMBOL_PX - half_px, 0], [0, 50], [0, -50]].map(([dx, dy]) => ({ text, half_px, dx, dy }));
    });
    const isFree = ({ half_px, dx, dy }) => left_px + dx >= half_px && left_px + dx <= this.map.getSize().x - half_px
      && taken.every((other) => Math.abs(other.x - x - dx) > other.half_px + half_px || Math.abs(other.y - y - dy) > HEIGHT_PX);
    const { text, half_px, dx, dy } = places.find(isFree) ?? places.at(-6);
    taken.push({ x: x + dx, y: y + dy, half_px });
    const label = h("span", { class: "name", text });
    Object.assign(label.style, { left: `${dx}px`, top: `${dy}px` });
    return label;
  }

  /** Marker of an element whose origin is the position. */
  #marker(one, name, children, options = {}) {
    const html = h("div", {}, children);
    return this.L.marker(latLng(one), { interactive: false, keyboard: false, ...options, icon: this.L.divIcon({ className: `symbol ${name}`, html, iconSize: null }) });
  }

  #shape(rings, name, closed = true) {
    const options = { className: name, interactive: false, fillRule: "nonzero", smoothFactor: 0 };
    return closed ? this.L.polygon(rings, options) : this.L.polyline(rings, options);
  }

  #drawFrame(bounds) {
    const [south, north, west, east] = [Math.max(-85, bounds.getSouth()), Math.min(85, bounds.getNorth()), bounds.getWest(), bounds.getEast()];
    const size = this.map.getSize();
    const [lats, lons] = [frameLines(south, north, size.y / LINE_PX), frameLines(west, east, size.x / LINE_PX)];
    this.frame.clearLayers();
    const lines = [...lats.map((lat) => [[lat, west], [lat, east]]), ...lons.map((lon) => [[south, lon], [north, lon]])];
    this.frame.addLayer(this.#shape(lines, "frame-line", false));
    // The lowest line has no label: that of the first meridian is there.
    const labelled = lats.filter((lat) => this.map.latLngToContainerPoint([lat, west]).y < size.y - LINE_PX / 4);
    for (const lat of labelled) this.frame.addLayer(this.#marker({ lat_deg: lat, lon_deg: west }, "frame-label at-west", h("span", { text: latitude(lat) })));
    for (const lon of lons) this.frame.addLayer(this.#marker({ lat_deg: south, lon_deg: lon }, "frame-label at-south", h("span", { text: longitude(nearLongitude(lon, 0)) })));
  }

  #pixelsPerMetre() {
    const degree_px = (TILE_PX * 2 ** this.map.getZoom()) / 360;
    return degree_px / metresPerDegree(this.map.getCenter().lat).east;
  }

  #drawVessel(vessel, ring_m) {
    for (const radius_m of ring_m) {
      const ring = circle(vessel, radius_m);
      this.ground.addLayer(this.#shape([ring], "ring"));
      this.ground.addLayer(this.#marker({ lat_deg: ring[0][0], lon_deg: ring[0][1] }, "ring-label", h("span", { text: rangeText(radius_m) })));
    }
    this.ground.addLayer(this.#marker(vessel, "vessel", [h("i", { class: "hull" }), h("span", { class: "name", text: t("map.vessel") })]));
  }

  /** Circle around the vessel on which a vehicle was when its distance was measured. */
  #drawRange(vessel, name, { distance_m, measured_utc_s }) {
    const ring = circle(vessel, distance_m);
    this.vehicles.addLayer(this.#shape([ring], "measured-range"));
    const text = t("map.measured_range", { name, range: rangeText(distance_m), age: age(measured_utc_s) });
    this.vehicles.addLayer(this.#marker({ lat_deg: ring[0][0], lon_deg: ring[0][1] }, "ring-label", h("span", { text })));
  }

  #drawVehicle(one, taken) {
    const hull = h("i", { class: one.heading_deg === null ? "hull unknown" : "hull" });
    if (one.heading_deg !== null) hull.style.rotate = `${one.heading_deg}deg`;
    const stale = isStale(one.position_utc_s, state.info.stale_after_s.vehicle);
    const name = stale ? t("map.stale", { name: one.vehicle_id, age: age(one.position_utc_s) }) : one.vehicle_id;
    this.vehicles.addLayer(this.#marker(one, stale ? "vehicle old" : "vehicle", [hull, this.#label(one, [name, one.vehicle_id], taken)]));
  }

  #drawContacts(/** @type {Contact[]} */ contacts, chosen) {
    const points = [];
    let selected = null;
    for (const contact of contacts) {
      if (contact.id === chosen) selected = contact;
      else points.push({ contact, ...this.#pixel(contact) });
    }
    const found = clusters(points, CLUSTER_PX);
    const named = found.length <= NAMED_SYMBOLS;
    const half_px = named ? NAME_PX / 2 : SYMBOL_PX;
    this.symbols = (selected ? [...points, this.#pixel(selected)] : points).map(({ x, y }) => ({ x: x + half_px - SYMBOL_PX, y, half_px }));
    for (const one of found) this.contacts.addLayer(one.contacts.length > 1 ? this.#cluster(one) : this.#contact(one.contacts[0], named));
    if (selected) this.contacts.addLayer(this.#contact(selected, true, true));
  }

  #pixel(contact) {
    const { x, y } = this.map.project(latLng(contact));
    return { x, y };
  }

  #contact(one, named, chosen = false) {
    if (one.sigma_m * this.#pixelsPerMetre() > CIRCLE_PX) this.contacts.addLayer(this.#shape([circle(one, one.sigma_m, 48)], `sigma ${one.review}`));
    const parts = [];
    if (one.heading_deg !== null) {
      const tick = h("i", { class: "tick" });
      tick.style.rotate = `${one.heading_deg}deg`;
      parts.push(tick);
    }
    parts.push(h("b", { class: one.atd_class === "structure" ? "dot structure" : "dot", text: symbol(one.review) }));
    if (named) parts.push(h("span", { class: "name", text: one.name.split("/").at(-1) }));
    const title = `${one.name}: ${verdict(one.review)}`;
    const marker = this.#marker(one, `contact ${one.review}${chosen ? " chosen" : ""}`, parts, { interactive: true, title, zIndexOffset: chosen ? 1e6 : 0 });
    return marker.on("click", () => this.select([one]));
  }

  #cluster({ contacts, review }) {
    const mean = (name) => contacts.reduce((sum, one) => sum + one[name], 0) / contacts.length;
    const title = t("map.cluster", { count: contacts.length, verdict: verdict(review) });
    const place = { lat_deg: mean("lat_deg"), lon_deg: mean("lon_deg") };
    const dot = h("b", { class: "dot" }, h("i", { text: symbol(review) }), h("span", { text: number(contacts.length) }));
    return this.#marker(place, `cluster ${review}`, dot, { interactive: true, title }).on("click", () => this.select(contacts));
  }
}
