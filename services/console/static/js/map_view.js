// Map without internet: contacts, tracks and vehicles in local metres, with scale, north arrow and range rings.

import { api } from "./api.js";
import { debounce, fill, h } from "./dom.js";
import { probabilities, quantity, received, symbol, time, verdict } from "./format.js";
import { MapTiles, drawContacts, drawFrame, drawTracks, nearest } from "./map_drawing.js";
import { emit, listen, state } from "./state.js";

export class MapView {
  constructor() {
    this.data = null;
    this.centre = { x: 0, y: 0 };
    this.pixelsPerMetre = 1; // CSS pixels
    this.fitted = false;
    this.chosen = null;
    this.canvas = h("canvas", { tabindex: 0, role: "img", "aria-label": "Map of contacts in local metres" });
    this.card = h("div", { "aria-live": "polite" });
    this.element = h("section", { class: "map hidden", "aria-label": "Map" }, this.canvas, h("aside", { class: "legend", tabindex: 0, "aria-label": "Legend" },
      h("h2", { text: "Map" }), h("ul", {}, ["unreviewed", "mine_like", "disputed", "not_mine_like", "unsure"].map((name) => h("li", {}, h("span", { class: `sample ${name}`, text: symbol(name) }), verdict(name)))),
      h("p", { class: "muted" }, h("kbd", { text: "j" }), " ", h("kbd", { text: "k" }), " next, previous · ", h("kbd", { text: "Enter" }), " review · ", h("kbd", { text: "+" }), " ", h("kbd", { text: "-" }), " ", h("kbd", { text: "0" }), " zoom · arrows move"),
      this.card));
    this.tiles = new MapTiles(() => this.draw());
    new ResizeObserver(() => { if (!this.fitted) this.fit(); this.draw(); }).observe(this.canvas);
    this.#startMouse();
    this.loadSoon = debounce(() => this.load(), 300, 1500);
    for (const name of ["contact", "fleet", "reload"]) listen(name, () => { if (this.visible) this.loadSoon(); });
    listen("theme", () => this.draw());
  }

  get visible() { return !this.element.classList.contains("hidden"); }

  async load() {
    this.data = await api.map();
    if (!this.fitted) this.fit();
    this.draw();
  }

  /** Fit the map to all objects. */
  fit() {
    if (!this.data || this.canvas.clientWidth === 0) return;
    const { contacts, vehicles, vessel } = this.data;
    const points = [...contacts.map((one) => [one.x_m, one.y_m]), ...vehicles.flatMap((one) => one.track), ...(vessel ? [[vessel.x_m, vessel.y_m]] : [])];
    if (!points.length) return;
    const span = (index) => [Math.min(...points.map((one) => one[index])), Math.max(...points.map((one) => one[index]))];
    const [[west, east], [south, north]] = [span(0), span(1)];
    this.centre = { x: (west + east) / 2, y: (south + north) / 2 };
    this.pixelsPerMetre = 0.82 * Math.min(this.canvas.clientWidth / Math.max(40, east - west), this.canvas.clientHeight / Math.max(40, north - south));
    this.fitted = true;
    this.draw();
  }

  toScreen = (x_m, y_m) => [
    this.canvas.clientWidth / 2 + (x_m - this.centre.x) * this.pixelsPerMetre,
    this.canvas.clientHeight / 2 - (y_m - this.centre.y) * this.pixelsPerMetre,
  ];

  zoom(factor, x = this.canvas.clientWidth / 2, y = this.canvas.clientHeight / 2) {
    const dx = (x - this.canvas.clientWidth / 2) / this.pixelsPerMetre;
    const dy = (this.canvas.clientHeight / 2 - y) / this.pixelsPerMetre;
    const before = this.pixelsPerMetre;
    this.pixelsPerMetre = Math.max(0.0005, Math.min(200, this.pixelsPerMetre * factor));
    const factorLeft = 1 - before / this.pixelsPerMetre;
    this.centre = { x: this.centre.x + dx * factorLeft, y: this.centre.y + dy * factorLeft };
    this.draw();
  }

  pan(dx, dy) {
    this.centre = { x: this.centre.x - dx / this.pixelsPerMetre, y: this.centre.y + dy / this.pixelsPerMetre };
    this.draw();
  }

  /** Select the next contact, from west to east. */
  move(step) {
    const contacts = (this.data?.contacts ?? []).slice().sort((a, b) => a.x_m - b.x_m || a.y_m - b.y_m);
    if (!contacts.length) return;
    const index = contacts.findIndex((one) => one.id === this.chosen);
    this.choose(contacts[Math.max(0, Math.min(contacts.length - 1, index < 0 ? 0 : index + step))].id);
  }

  async choose(id) {
    this.chosen = id;
    const one = this.data.contacts.find((contact) => contact.id === id);
    const [x, y] = this.toScreen(one.x_m, one.y_m);
    if (x < 30 || y < 30 || x > this.canvas.clientWidth - 30 || y > this.canvas.clientHeight - 30) this.centre = { x: one.x_m, y: one.y_m };
    this.draw();
    const { contact } = await api.contact(id);
    if (this.chosen !== id) return;
    fill(this.card, h("div", { class: "card" }, h("h3", {}, contact.name, h("span", { class: `badge ${contact.review}`, text: `${symbol(contact.review)} ${verdict(contact.review)}` })),
      contact.has_picture ? h("img", { src: contact.thumbnail, alt: "" }) : null,
      h("p", { class: "number", text: `${quantity(one.x_m, "m", 0)} east, ${quantity(one.y_m, "m", 0)} north of the origin, ± ${quantity(one.sigma_m, "m", 0)}` }),
      h("p", { class: "number", text: `ATD ${contact.atd_class ? `${contact.atd_class} ` : ""}${quantity(contact.atd_confidence, "", 2)} · ${received(contact)} · ${time(contact.seen_utc_s)}` }),
      probabilities(contact) ? h("p", { class: "number probabilities", text: probabilities(contact) }) : null,
      h("button", { type: "button", class: "primary", on: { click: () => this.open() } }, "review ", h("kbd", { text: "Enter" }))));
  }

  open() {
    if (!this.chosen) return;
    emit("view", { name: "review" });
    emit("select", { id: this.chosen });
  }

  draw() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!this.data || width === 0) return;
    const ratio = devicePixelRatio || 1;
    this.canvas.width = Math.round(width * ratio);
    this.canvas.height = Math.round(height * ratio);
    const context = this.canvas.getContext("2d");
    context.scale(ratio, ratio);
    const style = getComputedStyle(this.canvas);
    const root = getComputedStyle(document.documentElement);
    const colour = (name) => root.getPropertyValue(`--${name}`).trim();
    const stage = { context, width, height, toScreen: this.toScreen, pixelsPerMetre: this.pixelsPerMetre, colour, centre: this.centre };
    context.font = `${0.85 * parseFloat(style.fontSize)}px ${style.fontFamily}`;
    this.tiles.draw(stage, this.data.origin);
    drawFrame(stage, this.data);
    drawTracks(stage, this.data);
    drawContacts(stage, this.data.contacts, this.chosen ?? state.selected);
  }

  #startMouse() {
    let dragStart = null;
    let moved = false;
    this.canvas.addEventListener("wheel", (event) => { event.preventDefault(); this.zoom(event.deltaY < 0 ? 1.25 : 0.8, event.offsetX, event.offsetY); }, { passive: false });
    this.canvas.addEventListener("pointerdown", (event) => { dragStart = [event.clientX, event.clientY]; moved = false; });
    this.canvas.addEventListener("pointermove", (event) => {
      if (!dragStart) return;
      const [dx, dy] = [event.clientX - dragStart[0], event.clientY - dragStart[1]];
      moved ||= Math.hypot(dx, dy) > 3;
      if (!moved) return;
      this.pan(dx, dy);
      dragStart = [event.clientX, event.clientY];
    });
    this.canvas.addEventListener("pointerup", (event) => {
      const found = dragStart && !moved && this.data ? nearest(this.data.contacts, this.toScreen, event.offsetX, event.offsetY) : null;
      dragStart = null;
      if (found) this.choose(found.id);
    });
  }
}
