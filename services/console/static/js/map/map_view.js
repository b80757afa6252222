// Map without internet: contacts, vehicles and vessel by latitude and longitude, with a list of the contacts in the view.

import { api, inOrder } from "../base/api.js";
import { debounce, fill, h, notUpdated, toast } from "../base/dom.js";
import { area, className, position, probability, quantity, received, symbol, time, verdict } from "../base/format.js";
import { since } from "../base/ages.js";
import { nearLongitude, rangeBearing, swath } from "./map_geometry.js";
import { MapLayers, latLng, rangeText } from "./map_layers.js";
import { emit, listen, state } from "../base/state.js";
import { t } from "../texts.js";

const VENDOR = "/static/vendor/leaflet";
const MAX_ZOOM = 22; // 2 cm a pixel at 56° N
const FIT_ZOOM = 19;
const MARGIN_PX = 30; // a selected contact is at least this far from the edge

let leaflet = null;

/** Load Leaflet at its first use. */
function loadLeaflet() {
  const style = h("link", { rel: "stylesheet", href: `${VENDOR}/leaflet.css` });
  leaflet ??= Promise.all([
    import(`${VENDOR}/leaflet.js`),
    new Promise((resolve, reject) => {
      style.addEventListener("load", resolve);
      style.addEventListener("error", () => reject(new Error(t("map.not_loaded"))));
      document.head.prepend(style);
    }),
  ]).then(([L]) => L).catch((error) => { leaflet = null; style.remove(); throw error; });
  return leaflet;
}

export class MapView {
  constructor() {
    this.data = null;
    this.map = null;
    this.fitted = false;
    this.chosen = null;
    this.chart = h("div", { class: "chart", tabindex: 0, role: "application", "aria-label": t("map.label") });
    this.readout = h("div", { class: "readout number" });
    const button = (label, text, action) => h("button", { type: "button", "aria-label": label, title: label, text, on: { click: action } });
    const bar = h("div", { class: "chart-bar" }, button(t("map.zoom_in"), "+", () => this.zoom(1.5)), button(t("map.zoom_out"), "−", () => this.zoom(1 / 1.5)),
      button(t("map.fit"), t("map.whole"), () => this.fit()));
    this.card = h("div", { "aria-live": "polite" });
    this.count = h("p", { class: "muted" });
    this.surveyed = h("p", { class: "surveyed number" });
    this.element = h("section", { class: "map hidden", "aria-label": t("header.view.map") },
      h("div", { class: "chart-side" }, this.chart, h("div", { class: "north", "aria-hidden": "true" }, h("i"), "N"), this.readout, bar),
      h("aside", { class: "legend", tabindex: 0, "aria-label": t("map.legend") }, h("h2", { text: t("header.view.map") }), this.#legend(), this.count, this.surveyed, this.card));
    new ResizeObserver(() => this.#resize()).observe(this.chart);
    this.loadSoon = debounce(() => this.load().catch(notUpdated), 300, 1500);
    this.request = inOrder(() => Promise.all([loadLeaflet(), api.map(), api.tracks()]));
    for (const name of ["contact", "reload"]) listen(name, () => { if (this.visible) this.loadSoon(); });
    this.newestStatus_s = 0;
    listen("fleet", () => {
      this.#drawVehicles();
      if (this.visible && newestStatus() > this.newestStatus_s) this.loadSoon();
    });
  }

  get visible() { return !this.element.classList.contains("hidden"); }

  get #contact() { return this.data?.contacts.find((one) => one.id === this.chosen) ?? null; }

  focus() { this.chart.focus(); }

  #legend() {
    const names = ["unreviewed", "mine_like", "disputed", "not_mine_like", "unsure"];
    return h("ul", { class: "verdict-signs" }, names.map((name) => h("li", {}, h("span", { class: `sample ${name}`, text: symbol(name) }), verdict(name))));
  }

  /** Load the contacts, and Leaflet at the first call. */
  async load() {
    this.newestStatus_s = newestStatus();
    const [L, { columns, contacts: rows, ...chart }, { tracks, surveyed }] = await this.request();
    const contacts = rows.map((row) => Object.fromEntries(columns.map((name, index) => [name, row[index]])));
    this.reference_deg = (chart.vessel ?? contacts.at(-1))?.lon_deg ?? 0;
    for (const one of contacts) one.lon_deg = this.#near(one.lon_deg);
    for (const track of tracks) for (const point of track.points) point[1] = this.#near(point[1]);
    contacts.sort((a, b) => a.lon_deg - b.lon_deg || a.lat_deg - b.lat_deg); // west to east
    const place = (lat_deg, lon_deg) => ({ lat_deg, lon_deg: this.#near(lon_deg) });
    const swaths = (surveyed?.legs ?? []).map(([lat, lon, toLat, toLon, range_m]) => [swath(place(lat, lon), place(toLat, toLon), range_m)]);
    this.data = { ...chart, contacts, tracks, swaths };
    this.surveyed.textContent = surveyed ? t("map.surveyed", { area: area(surveyed.area_m2), since: since(surveyed.since_utc_s) }) : t("map.not_surveyed");
    if (!this.map) this.#create(L);
    if (this.fitted || !this.fit()) this.draw();
  }

  #near(lon_deg) { return nearLongitude(lon_deg, this.reference_deg); }

  /** Vehicles of the fleet, on the side of the 180° meridian on which the contacts are. */
  get #vehicles() {
    return (state.fleet?.vehicles ?? []).map((one) => ({ ...one, lon_deg: one.lon_deg === null ? null : this.#near(one.lon_deg) }));
  }

  #drawVehicles() {
    if (this.data && this.visible) this.layers.drawVehicles(this.#vehicles, this.data.vessel);
  }

  #create(L) {
    const options = { keyboard: false, zoomControl: false, attributionControl: false, doubleClickZoom: false, tap: false, zoomSnap: 0.25, maxZoom: MAX_ZOOM };
    this.map = L.map(this.chart, { ...options, zoomAnimation: false, fadeAnimation: false, inertia: false }).setView([0, 0], 2);
    this.L = L;
    L.control.scale({ imperial: false, maxWidth: 150, position: "bottomright" }).addTo(this.map);
    this.layers = new MapLayers(L, this.map, (contacts) => this.#clicked(contacts));
    this.map.on("moveend resize", () => this.draw());
    this.map.on("mousemove click", ({ latlng }) => this.#follow(positionOf(latlng)));
    this.map.on("mouseout", () => { this.readout.textContent = ""; });
  }

  #resize() {
    if (!this.map || this.chart.clientWidth === 0) return;
    this.map.invalidateSize({ animate: false, pan: false });
    if (!this.fitted) this.fit();
  }

  /** Fit the map to all objects, which draws it. Returns false if there are none, or no size. */
  fit() {
    if (!this.data || this.chart.clientWidth === 0) return false;
    const { contacts, tracks, vessel } = this.data;
    const vehicles = this.#vehicles.filter((one) => one.lat_deg !== null);
    const points = [...[...contacts, ...vehicles, ...(vessel ? [vessel] : [])].map(latLng), ...tracks.flatMap((track) => track.points)];
    if (!points.length) return false;
    this.fitted = true;
    this.map.invalidateSize({ animate: false, pan: false });
    this.map.fitBounds(this.L.latLngBounds(points).pad(0.1), { maxZoom: FIT_ZOOM, animate: false });
    return true;
  }

  /** Zoom around the selected contact if it is in the view, otherwise around the centre. */
  zoom(factor) {
    if (!this.map) return;
    const contact = this.#contact;
    const around = contact && this.map.getBounds().contains(latLng(contact)) ? latLng(contact) : this.map.getCenter();
    this.map.setZoomAround(around, this.map.getZoom() + Math.log2(factor), { animate: false });
  }

  pan(dx, dy) { this.map?.panBy([-dx, -dy], { animate: false }); }

  draw() {
    if (!this.data || this.chart.clientWidth === 0) return;
    this.layers.draw(this.data, this.chosen ?? state.selected);
    this.#drawVehicles();
    const { contacts, unlocated } = this.data;
    const bounds = this.map.getBounds();
    const inside = contacts.filter((one) => bounds.contains(latLng(one))).length;
    const counts = t("map.in_view", { count: inside, total: contacts.length + unlocated });
    this.count.textContent = unlocated ? `${counts} ${t("map.unlocated", { count: unlocated })}` : counts;
    this.element.dataset.drawn = String(this.data.contacts.length);
  }

  /** A click on a contact, or on a cluster of several. */
  #clicked(contacts) {
    if (contacts.length === 1) {
      this.choose(contacts[0].id);
      return;
    }
    const bounds = this.L.latLngBounds(contacts.map(latLng));
    const closer = bounds.pad(0.2);
    // Contacts at one place cannot be separated: each click selects the next of them.
    if (this.map.getBoundsZoom(closer) <= this.map.getZoom()) {
      const order = (one) => this.data.contacts.indexOf(one);
      const chosen = order(this.#contact);
      this.choose((contacts.find((one) => order(one) > chosen) ?? contacts[0]).id);
    } else this.map.fitBounds(closer, { animate: false });
  }

  /** Select the next contact, from west to east. */
  move(step) {
    const contacts = this.data?.contacts ?? [];
    if (!contacts.length) return;
    const index = contacts.findIndex((one) => one.id === this.chosen);
    const next = contacts[Math.max(0, Math.min(contacts.length - 1, index < 0 ? 0 : index + step))];
    this.choose(next.id);
  }

  async choose(id) {
    this.chosen = id;
    const one = this.#contact;
    const { x, y } = this.map.latLngToContainerPoint(latLng(one));
    const size = this.map.getSize();
    const visible = x > MARGIN_PX && y > MARGIN_PX && x < size.x - MARGIN_PX && y < size.y - MARGIN_PX;
    if (visible) this.draw();
    else this.map.setView(latLng(one), this.map.getZoom(), { animate: false });
    try {
      const { contact } = await api.contact(id);
      if (this.chosen === id) this.#fillCard(contact, one);
    } catch (error) {
      toast(error.message, { bad: true });
    }
  }

  #fillCard(contact, one) {
    const { vessel } = this.data;
    const lines = [
      `${position(contact.lat_deg, contact.lon_deg)}${one.sigma_m === null ? "" : ` ± ${quantity(one.sigma_m, "m")}`}`,
      vessel ? t("map.from_vessel", { text: rangeBearingText(vessel, one) }) : null,
      [probability(contact), contact.atd_class && className(contact.atd_class)].filter(Boolean).join(" · "),
      [received(contact), time(contact.seen_utc_s)].join(" · "),
    ];
    fill(this.card, h("div", { class: "card" }, h("h3", {}, contact.name, h("span", { class: `badge ${contact.review}`, text: `${symbol(contact.review)} ${verdict(contact.review)}` })),
      contact.has_image ? h("img", { src: api.thumbnailUrl(contact.id, contact.version), alt: "" }) : null,
      lines.filter(Boolean).map((text) => h("p", { class: "number", text })),
      h("div", { class: "actions" }, h("button", { type: "button", class: "primary", on: { click: () => this.open() } }, t("map.review"), " ", h("kbd", { text: "Enter" })))));
  }

  /** Open the selected contact in review. */
  open() {
    if (!this.chosen) return;
    emit("view", { name: "review" });
    emit("select", { id: this.chosen });
  }

  #follow(cursor) {
    const { vessel } = this.data;
    const contact = this.#contact;
    const parts = [position(cursor.lat_deg, nearLongitude(cursor.lon_deg, 0))];
    if (vessel) parts.push(t("map.from_vessel", { text: rangeBearingText(vessel, cursor) }));
    if (contact) parts.push(t("map.from_contact", { name: contact.name, text: rangeBearingText(contact, cursor) }));
    fill(this.readout, parts.map((text) => h("span", { text })));
  }
}

/** Arrival of the newest status of a vehicle. */
const newestStatus = () => Math.max(0, ...(state.fleet?.vehicles ?? []).map((one) => one.status?.received_utc_s ?? 0));

/** Range and true bearing from one position to another. */
function rangeBearingText(from, to) {
  const { range_m, bearing_deg } = rangeBearing(from, to);
  return t("map.range_bearing", { range: rangeText(range_m), bearing: String(Math.round(bearing_deg) % 360).padStart(3, "0") });
}

const positionOf = ({ lat, lng }) => ({ lat_deg: lat, lon_deg: lng });
