// The object panel: all looks at one object side by side, one verdict for them, split and merge.

import { api } from "../base/api.js";
import { fill, h, toast } from "../base/dom.js";
import { DASH, position, quantity, symbol, time, verdict } from "../base/format.js";
import { autoRange, colourTable, colourise, loadImage } from "../image/image_data.js";
import { drawLook, drawRing, groundExtent, widestGap } from "./object_drawing.js";
import { emit, listen, state } from "../base/state.js";
import { t } from "../texts.js";

const VERDICTS = ["mine_like", "not_mine_like", "unsure"];
const bearing = (degrees) => `${String(Math.round(degrees) % 360).padStart(3, "0")}°`;
const themeColour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

/** Statement about a decision on less than has arrived; null without one. */
export function decidedOnLess(row) {
  if (!row.newer_detail) return null;
  const values = { symbol: symbol(row.review), version: row.decided_on.version, bytes: row.decided_on.bytes, here: row.bytes_received };
  return t(row.decided_on.bytes === null ? "object.decided_on_version" : "object.decided_on_bytes", values);
}

class ObjectPanel {
  constructor(object, selected) {
    this.selected = selected; // contact identifier
    this.images = new Map(); // contact → {look, image, coloured} that is drawn
    this.head = h("div", { class: "object-head" });
    this.ring = h("canvas", { class: "ring", role: "img" });
    this.grid = h("div", { class: "looks" });
    this.all = h("input", { type: "checkbox", id: "all-looks", checked: true, on: { change: () => this.#renderButtons() } });
    this.allText = h("span");
    this.buttons = VERDICTS.map((name, i) => h("button", {
      type: "button", class: name, data: { verdict: name }, on: { click: () => this.decide(name) },
    }, h("span", { text: symbol(name), "aria-hidden": "true" }), ` ${verdict(name)} `, h("kbd", { text: String(i + 1) })));
    this.nearby = h("div", { class: "nearby" });
    this.dialog = h("dialog", { class: "object", "aria-labelledby": "object-title", on: { cancel: (event) => { event.preventDefault(); this.close(); }, keydown: (event) => this.#key(event) } },
      h("h2", { id: "object-title" }), h("div", { class: "object-top" }, this.head, this.ring), this.grid,
      h("div", { class: "object-decision" }, h("label", {}, this.all, " ", this.allText), h("div", { class: "verdicts" }, this.buttons)),
      this.nearby, h("div", { class: "actions" }, h("button", { type: "button", text: t("object.close"), on: { click: () => this.close() } })));
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
    if (!object.looks.some((look) => look.contact.id === this.selected)) this.selected = object.looks[0].contact.id;
    this.dialog.querySelector("h2").textContent = t("object.title", { count: object.number_of_looks });
    const extent = (one) => (one ? `${quantity(one.value, "m")}${one.sigma === null || one.sigma < 0.05 ? "" : ` ± ${one.sigma.toFixed(1)}`}` : DASH);
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
    this.#renderNearby();
    this.#renderButtons();
    drawRing(this.ring, aspects, themeColour);
    this.#loadImages();
  }

  #tile(look) {
    const { contact } = look;
    const split = this.object.number_of_looks > 1 && state.session.may.decide
      ? h("button", { type: "button", class: "split", text: t("object.split"), title: t("object.split_title"), on: { click: () => this.#change(() => api.splitLook(this.object.id, contact.id)) } }) : null;
    return h("div", { class: "tile", data: { id: contact.id } },
      h("button", { type: "button", class: "image", "aria-label": t("object.open", { name: contact.name }), on: { click: () => this.#openLook(contact.id) } }, h("canvas", { "aria-hidden": "true" })),
      h("p", {}, h("b", { text: contact.name }), " ", h("span", { class: `badge ${contact.review}`, text: `${symbol(contact.review)} ${verdict(contact.review)}` })),
      h("p", { class: "number", text: t("object.look", { time: time(look.seen_utc_s ?? contact.first_frame_utc_s), bytes: contact.bytes_received, aspect: look.aspect_deg === null ? DASH : bearing(look.aspect_deg) }) }),
      contact.newer_detail ? h("p", { class: "stale", text: decidedOnLess(contact) }) : null, split);
  }

  #renderNearby() {
    const { nearby } = this.object;
    fill(this.nearby, nearby.length && state.session.may.decide ? [h("h3", { text: t("object.nearby") }), nearby.map(({ contact, distance_m }) => h("button", {
      type: "button", data: { merge: contact.id }, title: t("object.merge_title"), text: t("object.merge", { name: contact.name, distance: quantity(distance_m, "m", 0) }),
      on: { click: () => this.#change(() => api.mergeObjects(this.object.id, contact.id)) },
    }))] : null);
  }

  #renderButtons() {
    this.allText.textContent = t("object.all", { count: this.object.number_of_looks });
    for (const tile of this.grid.children) {
      const { id } = tile.dataset;
      tile.classList.toggle("selected", id === this.selected);
      tile.classList.toggle("decides", (this.all.checked || id === this.selected) && this.images.has(id));
    }
    const ready = state.session.may.decide && this.#decidedLooks().length > 0;
    for (const button of this.buttons) button.disabled = !ready;
  }

  /** Load the images, then draw all at one scale. */
  async #loadImages() {
    const { object } = this;
    const pictures = object.looks.filter((look) => look.contact.has_picture);
    const loaded = await Promise.all(pictures.map(async (look) => {
      const { id, version } = look.contact;
      const known = this.images.get(id);
      if (known?.look.contact.version === version) return { ...known, look };
      try {
        const image = await loadImage({ id, version, sha256: look.sha256, layer: "raw" }, api.imageUrl(id, version, "raw"), look.has_missing ? api.maskUrl(id, version, "missing", "raw") : null, null);
        const [low, high] = autoRange(image);
        return { look, image, coloured: colourise(image, colourTable("grey", low, high, 1)) };
      } catch (error) {
        toast(`${look.contact.name}: ${error.message}`, { bad: true });
        return null;
      }
    }));
    if (this.object !== object || !this.open) return;
    this.images = new Map(loaded.filter(Boolean).map((one) => [one.look.contact.id, one]));
    this.draw();
    this.#renderButtons();
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

  /** Looks that a verdict applies to: their images are drawn. */
  #decidedLooks() {
    const drawn = [...this.images.values()].map(({ look }) => look);
    return this.all.checked ? drawn : drawn.filter((look) => look.contact.id === this.selected);
  }

  async decide(name) {
    const looks = this.#decidedLooks();
    if (!looks.length || !state.session.may.decide) return;
    const body = {
      verdict: name,
      looks: looks.map(({ contact, sha256 }) => ({ contact: contact.id, revision: contact.revision, version: contact.version, sha256, layer: "raw" })),
    };
    const stored = await this.#change(() => api.decideObject(this.object.id, body), (response) => response.object);
    if (stored) toast(t("object.decided", { count: looks.length, verdict: verdict(name) }));
  }

  /** Send a change, and display the object that the server returns. Returns whether it was stored. */
  async #change(send, objectOf = (response) => response) {
    try {
      const response = await send();
      const object = objectOf(response);
      if (this.open && object) this.show(object);
      else this.close();
      emit("changed", { id: state.selected });
      return true;
    } catch (error) {
      toast(error.message, { bad: true });
      return false;
    }
  }

  async reload() {
    try {
      const { contact } = await api.contact(this.selected);
      if (contact.object !== null && this.open) this.show(await api.object(contact.object));
    } catch (error) {
      toast(error.message, { bad: true });
    }
  }

  #key(event) {
    const name = VERDICTS[Number(event.key) - 1];
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (name) this.decide(name);
    else if (event.key === "O") this.close();
    else if (event.key === "o") {
      const ids = this.object.looks.map((look) => look.contact.id);
      this.selected = ids[(ids.indexOf(this.selected) + 1) % ids.length];
      this.#renderButtons();
    } else return;
    event.preventDefault();
  }
}

let panel = null;

/** Open the panel of a contact's object. */
export async function openObject(contact) {
  if (contact.object === null) {
    toast(t("object.no_position"));
    return;
  }
  try {
    panel = new ObjectPanel(await api.object(contact.object), contact.id);
  } catch (error) {
    toast(error.message, { bad: true });
  }
}

/** Update the open panel when one of its looks changes. */
export function watchObject() {
  listen("contact", ({ contact }) => {
    if (panel?.open && (contact.object === panel.object.id || panel.object.looks.some((look) => look.contact.id === contact.id))) panel.reload();
  });
  addEventListener("resize", () => { if (panel?.open) panel.draw(); });
}
