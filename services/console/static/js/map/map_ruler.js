// Ruler of the map: range and bearing between two positions.

import { h } from "../base/dom.js";
import { rangeBearing } from "./map_geometry.js";
import { latLng, rangeText } from "./map_layers.js";
import { t } from "../texts.js";

/** Range and true bearing from one position to another. */
export function rangeBearingText(from, to) {
  const { range_m, bearing_deg } = rangeBearing(from, to);
  return t("map.range_bearing", { range: rangeText(range_m), bearing: String(Math.round(bearing_deg) % 360).padStart(3, "0") });
}

export class MapRuler {
  /** `L`: Leaflet; `report(text)` receives the result of each measurement. */
  constructor(L, map, report) {
    this.L = L;
    this.layers = L.layerGroup().addTo(map);
    this.report = report;
    this.active = false;
    this.map = map;
  }

  /** Start at the selected contact, if there is one: its position is replaced by the first click. */
  start(contact) {
    this.active = true;
    this.from = contact;
    this.to = null;
    this.provisional = contact !== null;
    this.map.getContainer().classList.add("measuring");
    this.report(t("map.measure_hint"));
    this.#draw(null);
  }

  stop() {
    this.active = false;
    this.map.getContainer().classList.remove("measuring");
    this.layers.clearLayers();
    this.report("");
  }

  /** A click on a position: start and end in turn. */
  click(position) {
    if (!this.from || this.to || this.provisional) [this.from, this.to, this.provisional] = [position, null, false];
    else this.to = position;
    this.#draw(this.to);
    if (this.to) this.report(rangeBearingText(this.from, this.to));
  }

  /** A contact that was selected by keys: the end, or the start if there is none. */
  reach(contact) {
    if (this.from) this.to = contact;
    else this.from = contact;
    this.#draw(this.to);
    if (this.to) this.report(rangeBearingText(this.from, this.to));
  }

  /** Show the line to the cursor until the end is set. */
  follow(position) {
    if (this.active && this.from && !this.to) this.#draw(position);
  }

  #draw(to) {
    this.layers.clearLayers();
    if (!this.from) return;
    const ends = to ? [this.from, to] : [this.from];
    for (const one of ends) this.layers.addLayer(this.#label(one, h("i", { class: "end" })));
    if (!to) return;
    this.layers.addLayer(this.L.polyline(ends.map(latLng), { className: "ruler-line", interactive: false }));
    this.layers.addLayer(this.#label(to, h("span", { class: "name", text: rangeBearingText(this.from, to) })));
  }

  #label(at, content) {
    return this.L.marker(latLng(at), { interactive: false, keyboard: false, icon: this.L.divIcon({ className: "symbol ruler", html: content, iconSize: null }) });
  }
}
