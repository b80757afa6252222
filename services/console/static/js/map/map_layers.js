// Layers of the map: tiles, frame, range rings, vehicles, bands, and contacts with their clusters.

import { age } from "../base/ages.js";
import { h } from "../base/dom.js";
import { latitude, longitude, symbol, verdict } from "../base/format.js";
import { band, circle, clusters, frameLines, metresPerDegree, nearLongitude } from "./map_geometry.js";
import { state } from "../base/state.js";
import { t } from "../texts.js";

const CLUSTER_PX = 30;
const NAMED_SYMBOLS = 60; // above this number only the selected contact has its name
const CIRCLE_PX = 16; // a smaller position circle is hidden by the symbol
const BAND_PX = 2;
const LINE_PX = 130; // distance of the frame's lines
const TILE_PX = 256;

export const rangeText = (range_m) => (range_m >= 1000 ? `${Number((range_m / 1000).toFixed(2))}\u202fkm` : `${Math.round(range_m)}\u202fm`);
export const latLng = (one) => [one.lat_deg, one.lon_deg];

export class MapLayers {
  /** `L`: Leaflet; `select(contacts)` is called with the contacts of a symbol that was clicked. */
  constructor(L, map, select) {
    this.L = L;
    this.map = map;
    this.select = select;
    this.frame = L.layerGroup().addTo(map);
    this.ground = L.layerGroup().addTo(map);
    this.contacts = L.layerGroup().addTo(map);
    const { tiles } = state.info;
    if (tiles) L.tileLayer(tiles.url, { minZoom: tiles.min_zoom, maxNativeZoom: tiles.max_zoom, maxZoom: map.getMaxZoom() }).addTo(map);
  }

  /** Draw all layers. `contacts` are all contacts, `chosen` is the identifier of the selected one. */
  draw({ contacts, vehicles, tracks, ranges, vessel, ring_m }, chosen) {
    const bounds = this.map.getBounds();
    this.#drawFrame(bounds);
    this.ground.clearLayers();
    this.contacts.clearLayers();
    const wide = bounds.pad(0.3);
    const inside = contacts.filter((one) => wide.contains(latLng(one)));
    this.#drawBands(inside);
    if (vessel) this.#drawVessel(vessel, ring_m);
    if (vessel) for (const one of ranges) this.#drawRange(vessel, one);
    for (const track of tracks) this.ground.addLayer(this.#shape(track.points, "track", false));
    for (const vehicle of vehicles) this.#drawVehicle(vehicle);
    this.#drawContacts(inside, chosen);
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

  #drawBands(contacts) {
    const scale = this.#pixelsPerMetre();
    const bands = contacts.map(band).filter(Boolean);
    if (!bands.length || !contacts.some((one) => one.along_m * scale > BAND_PX)) return;
    this.ground.addLayer(this.#shape(bands.map((ring) => [ring]), "band"));
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
  #drawRange(vessel, one) {
    const ring = circle(vessel, one.distance_m);
    this.ground.addLayer(this.#shape([ring], "measured-range"));
    const text = t("map.measured_range", { name: one.vehicle_id, range: rangeText(one.distance_m), age: age(one.measured_utc_s) });
    this.ground.addLayer(this.#marker({ lat_deg: ring[0][0], lon_deg: ring[0][1] }, "ring-label", h("span", { text })));
  }

  #drawVehicle(one) {
    const hull = h("i", { class: one.heading_deg === null ? "hull unknown" : "hull" });
    if (one.heading_deg !== null) hull.style.rotate = `${one.heading_deg}deg`;
    const name = one.stale ? t("map.stale", { name: one.vehicle_id }) : one.vehicle_id;
    this.ground.addLayer(this.#marker(one, one.stale ? "vehicle old" : "vehicle", [hull, h("span", { class: "name", text: name })]));
  }

  #drawContacts(contacts, chosen) {
    const points = [];
    let selected = null;
    for (const contact of contacts) {
      if (contact.id === chosen) selected = contact;
      else points.push({ contact, ...this.#pixel(contact) });
    }
    const found = clusters(points, CLUSTER_PX);
    const named = found.length <= NAMED_SYMBOLS;
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
    const dot = h("b", { class: "dot" }, h("i", { text: symbol(review) }), h("span", { text: String(contacts.length) }));
    return this.#marker(place, `cluster ${review}`, dot, { interactive: true, title }).on("click", () => this.select(contacts));
  }
}
