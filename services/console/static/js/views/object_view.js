// The object panel: all looks at one object side by side, one verdict for them, split and merge.

import { api, inOrder } from "../base/api.js";
import { fill, h, notUpdated, toast } from "../base/dom.js";
import { SEEN_MS } from "../decision/verdict_guard.js";
import { DASH, VERDICTS, number, position, quantity, symbol, time, verdict } from "../base/format.js";
import { autoRange, colourTable, colourise, loadImage } from "../image/image_data.js";
import { drawLook, drawRing, groundExtent, widestGap } from "./object_drawing.js";
import { keysOff } from "../base/shortcuts.js";
import { emit, listen, state } from "../base/state.js";
import { t } from "../texts.js";

const bearing = (degrees) => `${String(Math.round(degrees) % 360).padStart(3, "0")}°`;
const themeColour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

/** Statement about a decision on less than has arrived; null without one. */
export function decidedOnLess(row) {
  if (!row.newer_detail) return null;
  const values = { symbol: symbol(row.review), version: row.decided_on.version, bytes: row.decided_on.bytes, here: row.bytes_received };
  return t(row.decided_on.bytes === null ? "object.decided_on_version" : "object.decided_on_bytes", values);
}

class ObjectPanel {
  constructor(object) {
    this.ready = false; // a verdict counts
    this.timer = 0;
    this.images = new Map(); // contact → {look, image, coloured} that is drawn
    this.load = inOrder(() => api.object(this.object.id));
    this.head = h("div", { class: "object-head" });
    this.ring = h("canvas", { class: "ring", role: "img" });
    this.grid = h("div", { class: "looks" });
    this.decided = h("span"); // what a verdict applies to
    this.buttons = VERDICTS.map((name, i) => h("button", {
      type: "button", class: name, data: { verdict: name }, on: { click: () => this.decide(name) },
    }, h("span", { text: symbol(name), "aria-hidden": "true" }), ` ${verdict(name)} `, h("kbd", { text: String(i + 1) })));
    this.changes = h("div", { class: "menu-list" });
    this.menu = h("details", { class: "object-menu" }, h("summary", { text: t("object.menu") }), this.changes);
    this.dialog = h("dialog", { class: "object", "aria-labelledby": "object-title", on: { cancel: (event) => { event.preventDefault(); this.close(); }, keydown: (event) => this.#key(event) } },
      h("h2", { id: "object-title", tabindex: -1, autofocus: "" }), h("div", { class: "object-top" }, this.head, this.ring), this.grid,
      h("div", { class: "object-decision" }, h("div", { class: "verdicts" }, this.buttons), this.decided),
      h("div", { class: "actions" }, this.menu, h("button", { type: "button", text: t("dialog.close"), on: { click: () => this.close() } })));
    document.body.append(this.dialog);
    this.dialog.showModal();
    this.show(object);
  }

  close() {
    this.dialog.close();
    this.dialog.remove();
  }

  get open() { return this.dialog.isConnected; }

  /** Display the object, or its new state. */
  show(object) {
    this.object = object;
    this.dialog.querySelector("h2").textContent = t("object.title", { count: object.number_of_looks });
    const extent = (one) => (one ? `${quantity(one.value, "m")}${one.sigma === null || one.sigma < 0.05 ? "" : ` ± ${number(one.sigma, 1)}`}` : DASH);
    const aspects = object.looks.map((look) => look.aspect_deg).filter((aspect) => aspect !== null);
    const gap = widestGap(aspects);
    fill(this.head,
      object.contradictory ? h("p", { class: "bad contradiction", text: t("object.contradictory") }) : null,
      h("p", { class: "number", text: t("object.position", { position: position(object.lat_deg, object.lon_deg), sigma: quantity(object.position_sigma_m, "m") }) }),
      h("p", { class: "number", text: t("object.size", { length: extent(object.length_m), width: extent(object.width_m), height: extent(object.height_m) }) }),
      h("p", { text: t("object.vehicles", { vehicles: object.vehicles.join(", ") }) }),
      h("p", { class: "number aspects", text: gap ? t("object.gap", { from: bearing(gap[0]), to: bearing(gap[1]) }) : t(aspects.length ? "object.no_gap" : "object.no_aspect") }));
    this.ring.setAttribute("aria-label", t("object.ring", { aspects: aspects.map(bearing).join(", ") || DASH }));
    fill(this.grid, object.looks.map((look) => this.#tile(look)));
    this.#renderMenu();
    drawRing(this.ring, aspects, themeColour);
    this.#loadImages();
  }

  #tile(look) {
    const { contact } = look;
    return h("div", { class: "tile", data: { id: contact.id } },
      h("button", { type: "button", class: "image", "aria-label": t("status_line.open_contact", { name: contact.name }), on: { click: () => this.#openLook(contact.id) } }, h("canvas", { "aria-hidden": "true" })),
      h("p", {}, h("b", { text: contact.name }), " ", h("span", { class: `badge ${contact.review}`, text: `${symbol(contact.review)} ${verdict(contact.review)}` })),
      h("p", { class: "number", text: t("object.look", { time: time(look.seen_utc_s ?? contact.first_frame_utc_s), bytes: contact.bytes_received, aspect: look.aspect_deg === null ? DASH : bearing(look.aspect_deg) }) }),
      contact.newer_detail ? h("p", { class: "stale", text: decidedOnLess(contact) }) : null);
  }

  /** Changes of the object: a look that shows another object, and objects within the association gate that are this one. */
  #renderMenu() {
    const { looks, nearby, id } = this.object;
    const button = (text, data, send) => h("button", { type: "button", data, text, on: { click: () => this.#change(send) } });
    const splits = looks.length > 1 ? looks.map(({ contact }) => button(t("object.split", { name: contact.name }), { split: contact.id }, () => api.splitLook(id, contact.id))) : [];
    const merges = nearby.map(({ contact, distance_m }) => button(t("object.merge", { name: contact.name, distance: quantity(distance_m, "m") }), { merge: contact.id }, () => api.mergeObjects(id, contact.id)));
    this.menu.classList.toggle("hidden", !state.session.may.decide || splits.length + merges.length === 0);
    fill(this.changes, splits, merges);
  }

  /** Draw the images that stay, load the others, then draw all at one scale. */
  async #loadImages() {
    const { object } = this;
    const images = object.looks.filter((look) => look.contact.has_image);
    const stays = ({ contact }) => this.images.get(contact.id)?.look.contact.version === contact.version;
    this.#display(images.filter(stays).map((look) => ({ ...this.images.get(look.contact.id), look })));
    const loaded = await Promise.all(images.map(async (look) => {
      const { id, version } = look.contact;
      if (this.images.has(id)) return this.images.get(id);
      try {
        const image = await loadImage({ id, version, sha256: look.sha256, layer: "raw" }, api.imageUrl(id, version), look.has_missing ? api.maskUrl(id, version) : null);
        const [low, high] = autoRange(image);
        return { look, image, coloured: colourise(image, colourTable("grey", low, high)) };
      } catch (error) {
        toast(`${look.contact.name}: ${error.message}`, { bad: true });
        return null;
      }
    }));
    if (this.object !== object || !this.open) return;
    const drawn = loaded.filter(Boolean);
    if (drawn.some(({ look, image }) => image !== this.images.get(look.contact.id)?.image)) this.#wait();
    this.#display(drawn);
  }

  /** Draw images; a verdict is on these. */
  #display(drawn) {
    this.images = new Map(drawn.map((one) => [one.look.contact.id, one]));
    this.draw();
    this.decided.textContent = t("object.all", { count: drawn.length });
    for (const button of this.buttons) button.disabled = !state.session.may.decide || drawn.length === 0;
  }

  #setReady(/** @type {boolean} */ ready) {
    this.ready = ready;
    this.dialog.dataset.ready = String(ready);
  }

  /** A verdict counts after each image was in sight for some time, and as long after the verdict before. */
  #wait() {
    clearTimeout(this.timer);
    this.#setReady(false);
    this.timer = setTimeout(() => this.#setReady(true), SEEN_MS);
  }

  draw() {
    const drawn = [...this.images.values()];
    const extent_m = Math.max(...drawn.map(({ look, image }) => groundExtent(look, image)), 0.1);
    for (const { look, image, coloured } of drawn) {
      const canvas = this.grid.querySelector(`[data-id="${CSS.escape(look.contact.id)}"] canvas`);
      drawLook(canvas, look, image, coloured, canvas.clientWidth / extent_m);
      canvas.dataset.shows = `${look.contact.id} ${look.contact.version}`;
    }
    this.dialog.dataset.scale = String(extent_m);
  }

  #openLook(id) {
    this.close();
    emit("select", { id });
  }

  /** Decide on all looks whose images are drawn. */
  async decide(name) {
    const looks = [...this.images.values()].map(({ look }) => look);
    if (!looks.length || !state.session.may.decide) return;
    if (!this.ready) {
      toast(t("decision_form.early"));
      return;
    }
    const body = {
      verdict: name,
      looks: looks.map(({ contact, sha256 }) => ({ contact: contact.id, revision: contact.revision, version: contact.version, sha256, layer: "raw" })),
    };
    clearTimeout(this.timer);
    this.#setReady(false);
    const stored = await this.#change(() => api.decideObject(this.object.id, body), (response) => response.object);
    this.#wait();
    if (stored) toast(t("object.decided", { count: looks.length, verdict: verdict(name) }));
  }

  /** Send a change, and display the object that the server returns. Returns whether it was stored. */
  async #change(send, objectOf = (response) => response) {
    try {
      const response = await send();
      const object = objectOf(response);
      if (this.open && object) this.show(object);
      else this.close();
      return true;
    } catch (error) {
      toast(error.message, { bad: true });
      return false;
    }
  }

  async reload() {
    try {
      const object = await this.load();
      if (this.open) this.show(object);
    } catch (error) {
      // Its looks are looks of another object now.
      if (error.status === 404) this.close();
      else notUpdated(error);
    }
  }

  #key(event) {
    if (keysOff() || event.repeat || event.ctrlKey || event.metaKey || event.altKey) return;
    // By the place of the key: on some keyboards digits need Shift.
    const name = VERDICTS[Number(/^Digit([1-3])$/.exec(event.code)?.[1] ?? event.key) - 1];
    if (!name) return;
    this.decide(name);
    event.preventDefault();
  }
}

let panel = null;

/** Open the panel of a contact's object, unless the operator has moved on to another contact or dialog. */
export async function openObject(contact) {
  try {
    const object = await api.object(contact.object);
    if (state.selected === contact.id && !document.querySelector("dialog[open]")) panel = new ObjectPanel(object);
  } catch (error) {
    toast(error.message, { bad: true });
  }
}

/** Update the open panel when one of its looks changes. */
export function watchObject() {
  listen("contact", ({ contact }) => {
    if (panel?.open && (contact.object === panel.object.id || panel.object.looks.some((look) => look.contact.id === contact.id))) panel.reload();
  });
  listen("reload", () => { if (panel?.open) panel.reload(); });
  addEventListener("resize", () => { if (panel?.open) panel.draw(); });
}
