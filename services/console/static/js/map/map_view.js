// Map without internet: contacts, vehicles and vessel by latitude and longitude, with a list of the contacts in the view.

import { api } from "../base/api.js";
import { debounce, fill, h, toast } from "../base/dom.js";
import { position, probabilities, quantity, received, symbol, time, verdict } from "../base/format.js";
import { nearLongitude } from "./map_geometry.js";
import { MapLayers, latLng } from "./map_layers.js";
import { MapRuler, rangeBearingText } from "./map_ruler.js";
import { emit, listen, state } from "../base/state.js";
import { t } from "../texts.js";

const VENDOR = "/static/vendor/leaflet";
const MAX_ZOOM = 22; // 2 cm a pixel at 56° N
const FIT_ZOOM = 19;
const MARGIN_PX = 30; // a selected contact is at least this far from the edge
const MAX_LISTED = 200;

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
  /** `request()` opens the request dialog of the contact that is displayed in review. */
  constructor(request) {
    this.requestDisplayed = request;
    this.data = null;
    this.map = null;
    this.fitted = false;
    this.chosen = null;
    this.chart = h("div", { class: "chart", tabindex: 0, role: "application", "aria-label": t("map.label") });
    this.readout = h("div", { class: "readout number" });
    this.measured = h("span", { class: "measured number", "aria-live": "polite" });
    this.measureButton = h("button", { type: "button", "aria-pressed": "false", on: { click: () => this.measure() } }, t("map.measure"), " ", h("kbd", { text: "m" }));
    const button = (label, text, action) => h("button", { type: "button", "aria-label": label, title: label, text, on: { click: action } });
    const bar = h("div", { class: "chart-bar" }, this.measureButton, button(t("map.zoom_in"), "+", () => this.zoom(1.5)), button(t("map.zoom_out"), "−", () => this.zoom(1 / 1.5)),
      button(t("map.fit"), t("map.whole"), () => this.fit()), this.measured);
    this.card = h("div", { "aria-live": "polite" });
    this.count = h("p", { class: "muted" });
    this.list = h("ul", { class: "in-view", role: "listbox", tabindex: 0, "aria-label": t("map.list"), on: { keydown: (event) => this.#onListKey(event), click: (event) => this.#onListClick(event) } });
    this.element = h("section", { class: "map hidden", "aria-label": t("map.title") },
      h("div", { class: "chart-side" }, this.chart, h("div", { class: "north", "aria-hidden": "true" }, h("i"), "N"), this.readout, bar),
      h("aside", { class: "legend", tabindex: 0, "aria-label": t("map.legend") }, h("h2", { text: t("map.title") }), this.#legend(), this.card, h("h3", { text: t("map.list") }), this.count, this.list));
    new ResizeObserver(() => this.#resize()).observe(this.chart);
    this.loadSoon = debounce(() => this.#load(), 300, 1500);
    for (const name of ["contact", "fleet", "reload"]) listen(name, () => { if (this.visible) this.loadSoon(); });
  }

  get visible() { return !this.element.classList.contains("hidden"); }

  get #contact() { return this.data?.contacts.find((one) => one.id === this.chosen) ?? null; }

  focus() { this.chart.focus(); }

  #legend() {
    const names = ["unreviewed", "mine_like", "disputed", "not_mine_like", "unsure"];
    return [
      h("ul", { class: "verdict-signs" }, names.map((name) => h("li", {}, h("span", { class: `sample ${name}`, text: symbol(name) }), verdict(name)))),
      h("p", { class: "muted map-keys" }, h("kbd", { text: "j" }), " ", h("kbd", { text: "k" }), ` ${t("map.keys.step")} · `, h("kbd", { text: "Enter" }), ` ${t("map.keys.review")} · `,
        h("kbd", { text: "+" }), " ", h("kbd", { text: "-" }), " ", h("kbd", { text: "0" }), ` ${t("map.keys.zoom")}`),
    ];
  }

  /** Load the contacts, and Leaflet at the first call. */
  async load() {
    const [L, data] = await Promise.all([loadLeaflet(), api.map()]);
    const reference_deg = (data.vessel ?? data.contacts.at(-1))?.lon_deg ?? 0;
    for (const one of [...data.contacts, ...data.vehicles]) one.lon_deg = nearLongitude(one.lon_deg, reference_deg);
    for (const track of data.tracks) for (const point of track.points) point[1] = nearLongitude(point[1], reference_deg);
    for (const one of data.contacts) if (one.vehicle_lon_deg !== null) one.vehicle_lon_deg = nearLongitude(one.vehicle_lon_deg, reference_deg);
    data.contacts.sort((a, b) => a.lon_deg - b.lon_deg || a.lat_deg - b.lat_deg); // west to east
    this.data = data;
    if (!this.map) this.#create(L);
    if (this.fitted || !this.fit()) this.draw();
  }

  async #load() {
    try {
      await this.load();
    } catch (error) {
      toast(error.message, { bad: true });
    }
  }

  #create(L) {
    const options = { keyboard: false, zoomControl: false, attributionControl: false, doubleClickZoom: false, tap: false, zoomSnap: 0.25, maxZoom: MAX_ZOOM };
    this.map = L.map(this.chart, { ...options, zoomAnimation: false, fadeAnimation: false, inertia: false }).setView([0, 0], 2);
    this.L = L;
    L.control.scale({ imperial: false, maxWidth: 150, position: "bottomright" }).addTo(this.map);
    this.layers = new MapLayers(L, this.map, (contacts) => this.#clicked(contacts));
    this.ruler = new MapRuler(L, this.map, (text) => { this.measured.textContent = text; });
    this.map.on("moveend resize", () => this.draw());
    this.map.on("click", ({ latlng }) => { if (this.ruler.active) this.ruler.click(positionOf(latlng)); });
    this.map.on("mousemove", ({ latlng }) => this.#follow(positionOf(latlng)));
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
    const { contacts, vehicles, tracks, vessel } = this.data;
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
    this.#fillList();
    this.element.dataset.drawn = String(this.data.contacts.length);
  }

  #fillList() {
    const bounds = this.map.getBounds();
    const inside = this.data.contacts.filter((one) => bounds.contains(latLng(one)));
    const { length: total } = this.data.contacts;
    const { unlocated } = this.data;
    const parts = [t("map.in_view", { count: inside.length, total })];
    if (inside.length > MAX_LISTED) parts.push(t("map.listed", { limit: MAX_LISTED }));
    if (unlocated) parts.push(t("map.unlocated", { count: unlocated }));
    this.count.textContent = parts.join(" ");
    // The selected contact is in the list.
    const index = inside.findIndex((one) => one.id === this.chosen);
    const first = Math.max(0, Math.min(index - MAX_LISTED / 2, inside.length - MAX_LISTED));
    fill(this.list, inside.slice(first, first + MAX_LISTED).map((one, number) => h("li", { id: `in-view-${number}`, role: "option", "aria-selected": String(one.id === this.chosen), data: { id: one.id } },
      h("span", { class: `sample ${one.review}`, "aria-hidden": "true", text: symbol(one.review) }), h("span", { class: "name", text: one.name }), " ",
      h("span", { class: "muted", text: verdict(one.review) }))));
    const selected = this.list.querySelector("[aria-selected=true]");
    if (selected) this.list.setAttribute("aria-activedescendant", selected.id);
    else this.list.removeAttribute("aria-activedescendant");
    // scrollIntoView would also move the card out of view.
    if (selected) this.list.scrollTop = selected.offsetTop - this.list.offsetTop - this.list.clientHeight / 2;
  }

  #onListKey(event) {
    const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    if (!step) return;
    event.preventDefault();
    event.stopPropagation();
    this.move(step);
  }

  #onListClick(event) {
    const id = event.target.closest("[role=option]")?.dataset.id;
    if (id) this.#clicked([this.data.contacts.find((one) => one.id === id)]);
  }

  /** A click on a contact, or on a cluster of several. */
  #clicked(contacts) {
    if (contacts.length === 1) {
      if (this.ruler.active) this.ruler.click(contacts[0]);
      else this.choose(contacts[0].id);
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
    if (this.ruler.active) this.ruler.reach(next);
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
    const button = (key, text, action, primary) => h("button", { type: "button", class: primary ? "primary" : "", on: { click: action } }, text, " ", h("kbd", { text: key }));
    const lines = [
      one.sigma_m === null ? position(one.lat_deg, contact.lon_deg) : `${position(one.lat_deg, contact.lon_deg)} ± ${quantity(one.sigma_m, "m", 0)}`,
      vessel ? t("map.from_vessel", { text: rangeBearingText(vessel, one) }) : null,
      t("map.detector", { type: contact.atd_class ?? "", value: quantity(contact.atd_confidence, "", 2), received: received(contact), time: time(contact.seen_utc_s) }),
      probabilities(contact),
    ];
    fill(this.card, h("div", { class: "card" }, h("h3", {}, contact.name, h("span", { class: `badge ${contact.review}`, text: `${symbol(contact.review)} ${verdict(contact.review)}` })),
      contact.has_picture ? h("img", { src: contact.thumbnail, alt: "" }) : null,
      lines.filter(Boolean).map((text) => h("p", { class: "number", text })),
      h("div", { class: "actions" }, button("Enter", t("map.review"), () => this.open(), true), button("r", t("map.request"), () => this.request())),
      h("p", { class: "muted" }, h("kbd", { text: "1" }), " ", h("kbd", { text: "2" }), " ", h("kbd", { text: "3" }), ` ${t("map.verdict_hint")}`)));
  }

  /** Open the selected contact in review. */
  open() {
    if (!this.chosen) return;
    emit("view", { name: "review" });
    emit("select", { id: this.chosen });
  }

  /** Open the selected contact in review, then its requests. */
  request() {
    if (!this.chosen) return;
    this.open();
    this.requestDisplayed();
  }

  /** Start or end measuring. */
  measure() {
    if (!this.map) return;
    if (this.ruler.active) this.ruler.stop();
    else this.ruler.start(this.#contact);
    this.measureButton.setAttribute("aria-pressed", String(this.ruler.active));
  }

  /** End measuring; otherwise focus the chart. */
  escape() {
    if (this.ruler?.active) this.measure();
    else this.focus();
  }

  #follow(cursor) {
    this.ruler.follow(cursor);
    const { vessel } = this.data;
    const contact = this.#contact;
    const parts = [position(cursor.lat_deg, nearLongitude(cursor.lon_deg, 0))];
    if (vessel) parts.push(t("map.from_vessel", { text: rangeBearingText(vessel, cursor) }));
    if (contact) parts.push(t("map.from_contact", { name: contact.name, text: rangeBearingText(contact, cursor) }));
    fill(this.readout, parts.map((text) => h("span", { text })));
  }
}

const positionOf = ({ lat, lng }) => ({ lat_deg: lat, lon_deg: lng });
