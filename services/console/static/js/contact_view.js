// The middle of the review: one contact's picture with its tools, its versions and what can be trusted in it.

import { api } from "./api.js";
import { h, fill, toast } from "./dom.js";
import { DASH, position, quantity, received, time } from "./format.js";
import { COMPARE, drawHint, drawTools, drawVersions, startMouse } from "./contact_tools.js";
import { honestyStrip } from "./honesty.js";
import { Measuring, lineOf } from "./measure.js";
import { MAPS, autoRange, loadPicture } from "./picture_data.js";
import { PictureView, freshSight } from "./picture_view.js";
import { setting, state } from "./state.js";

const GAIN_STEP = 5;

export class ContactView {
  constructor() {
    this.detail = null;
    this.version = null; // shown version's number
    this.follow = true; // show newer versions as they arrive
    this.layer = "raw";
    this.compare = "off";
    this.auto = true;
    this.loading = 0;
    this.cache = new Map();
    this.look = { map: setting("map") in MAPS ? setting("map") : "grey", low: 0, high: 100, gamma: 1, hatch: true };
    this.#build();
    this.measuring = new Measuring(() => this.#place(), () => this.#lines());
    startMouse(this);
  }

  #build() {
    const sight = freshSight();
    this.canvases = ["Picture of the contact", "Picture to compare with"].map((label) => h("canvas", { role: "img", "aria-label": label }));
    this.views = this.canvases.map((canvas) => new PictureView(canvas, sight));
    for (const view of this.views) view.look = this.look;
    this.heading = h("div", { class: "heading" });
    this.tools = h("div", { class: "tools", role: "toolbar", "aria-label": "Picture" });
    this.placeholder = h("p", { class: "placeholder" });
    this.stage = h("div", { class: "stage" }, this.canvases, this.placeholder);
    this.versions = h("div", { class: "versions", role: "toolbar", "aria-label": "Versions of the picture" });
    this.strip = h("div", { class: "strip", role: "region", "aria-label": "What can be trusted in this picture" });
    this.element = h("section", { class: "contact", "aria-label": "Contact" }, this.heading, this.tools, this.stage, this.versions, this.strip);
  }

  get shown() { return this.detail?.versions.find((one) => one.version === this.version) ?? null; }
  get shownLayer() { return this.shown?.layers.find((one) => one.name === this.layer) ?? null; }

  #place() {
    const view = this.views[0];
    return { id: this.detail?.contact.id, version: this.version, layer: this.layer, scale: view.scale, picture: view.picture };
  }

  /** Show another contact, or the same one as it is now. */
  async show(detail) {
    const other = detail.contact.id !== this.detail?.contact.id;
    this.detail = detail;
    const newest = detail.versions.at(-1)?.version ?? null;
    if (other) {
      this.follow = true;
      this.layer = "raw";
      this.auto = true;
      this.cache.clear();
      this.measuring.stop();
      Object.assign(this.views[0].sight, freshSight());
    }
    // A picture does not change under a hand that measures in it.
    if (other || (this.follow && !this.measuring.active)) this.version = newest;
    this.#words();
    await this.#pictures();
  }

  /** Show a version: a number, or a step from the shown one. */
  async showVersion(number) {
    const newest = this.detail?.versions.at(-1)?.version;
    if (!this.detail?.versions.some((one) => one.version === number)) return;
    this.version = number;
    this.follow = number === newest;
    this.measuring.stop();
    this.#words();
    await this.#pictures();
  }

  async stepVersion(step) {
    const index = this.detail?.versions.findIndex((one) => one.version === this.version) ?? -1;
    const wanted = this.detail?.versions[index + step];
    if (wanted) await this.showVersion(wanted.version);
  }

  async showLayer(name) {
    if (!this.shown?.layers.some((one) => one.name === name)) return;
    this.layer = name;
    if (!this.shownLayer.measurable && this.measuring.active) this.measuring.stop();
    this.#words();
    await this.#pictures();
  }

  async nextLayer() {
    const names = this.shown?.layers.map((one) => one.name) ?? [];
    if (names.length) await this.showLayer(names[(names.indexOf(this.layer) + 1) % names.length]);
  }

  /** The next way of comparing that there is something to show for. */
  async nextCompare() {
    if (!this.detail) return;
    const modes = Object.keys(COMPARE);
    do this.compare = modes[(modes.indexOf(this.compare) + 1) % modes.length];
    while (this.compare !== "off" && !this.second());
    this.#words();
    await this.#pictures();
  }

  /** What the second canvas shows: [version, layer], or null. */
  second() {
    const { versions } = this.detail;
    if (this.compare === "versions" && versions.length > 1) {
      const first = versions.find((one) => one.version !== this.version);
      return [first, "raw"];
    }
    if (this.compare === "layers" && this.shown) {
      const other = this.shown.layers.find((one) => one.name !== this.layer);
      return other ? [this.shown, other.name] : null;
    }
    return null;
  }

  async #load(version, layer) {
    const { id } = this.detail.contact;
    const key = `${id} ${version.version} ${layer}`;
    if (!this.cache.has(key)) {
      if (this.cache.size > 12) this.cache.delete(this.cache.keys().next().value);
      const made = version.layers.find((one) => one.name === layer)?.synthesised;
      this.cache.set(key, loadPicture(
        api.pictureUrl(id, version.version, layer),
        version.missing_fraction > 0 ? api.maskUrl(id, version.version, "missing", layer) : null,
        version.guessed_fraction > 0 && !made ? api.maskUrl(id, version.version, "guessed", layer) : null,
      ));
    }
    try {
      return await this.cache.get(key);
    } catch (error) {
      this.cache.delete(key);
      throw error;
    }
  }

  async #pictures() {
    const turn = (this.loading += 1);
    const second = this.shown ? this.second() : null;
    const wanted = [this.shown ? [this.shown, this.layer] : null, second];
    this.canvases[0].classList.toggle("hidden", !wanted[0]);
    this.canvases[1].classList.toggle("hidden", !wanted[1]);
    this.placeholder.textContent = this.shown && this.detail.contact.has_picture ? "" : "Only the contact's record has arrived. The picture follows as its frames do.";
    try {
      const pictures = await Promise.all(wanted.map((one) => one && this.#load(...one)));
      if (turn !== this.loading) return;
      if (this.auto && pictures[0]) [this.look.low, this.look.high] = autoRange(pictures[0]);
      pictures.forEach((picture, index) => picture && this.#showOn(this.views[index], picture, ...wanted[index]));
      this.canvases[0].dataset.shows = this.shown ? `${this.detail.contact.id} ${this.version} ${this.layer}` : "";
      this.#tools();
      this.#lines();
    } catch (error) {
      if (turn === this.loading) toast(error.message, { bad: true });
    }
  }

  #showOn(view, picture, version, layer) {
    const known = version.pixel_along_m && version.pixel_across_m;
    // A layer may have more pixels than the picture; its metres are the same.
    const scale = known ? {
      along_m: (version.pixel_along_m * version.height_px) / picture.height,
      across_m: (version.pixel_across_m * version.width_px) / picture.width,
    } : null;
    const title = `version ${version.version} · ${layer}${version.complete ? "" : ` · ${received(version)} received`}`;
    const made = version.layers.find((one) => one.name === layer)?.synthesised ?? false;
    view.show(picture, { scale, nadir: this.detail.record?.nadir_side ?? null, title, made });
  }

  #lines() {
    const kept = (this.detail?.measurements ?? []).filter((one) => one.version === this.version && one.layer === this.layer).map(lineOf);
    this.views[0].lines = [...(this.measuring.active ? [] : kept), ...this.measuring.lines()];
    this.views[0].cross = this.measuring.active && !this.measuring.result ? this.measuring.cross : null;
    this.views[0].draw();
    this.canvases[0].classList.toggle("measures", this.measuring.active);
    this.#hint();
  }

  /** Start measuring, or go to the next kind; says why where it is locked. */
  measure() {
    const why = this.measureLock();
    if (why) {
      toast(`Measuring is locked: ${why}`, { bad: true });
      return;
    }
    this.measuring.next();
    this.#tools();
    this.canvases[0].focus();
  }

  measureLock() {
    if (!this.shown) return "there is no picture yet";
    if (!state.session.may.measure) return "your role may not measure";
    if (!this.shownLayer?.measurable) return this.shownLayer?.reason || `the layer ${this.layer} is made up`;
    if (!this.views[0].scale) return "the size of a pixel is not known";
    return "";
  }

  zoom(factor) {
    this.views[0].zoom(factor);
    this.redrawAll();
  }

  fit() {
    Object.assign(this.views[0].sight, freshSight());
    this.redrawAll();
  }

  pan(across, along) {
    const { zoom } = this.views[0].sight;
    this.views[0].pan(across / zoom, along / zoom);
    this.redrawAll();
  }

  /** Make the picture brighter (1) or darker (-1); 0 is automatic again. */
  gain(step) {
    this.auto = step === 0;
    if (this.auto) {
      const { picture } = this.views[0];
      if (picture) [this.look.low, this.look.high] = autoRange(picture);
      this.look.gamma = 1;
    } else this.look.high = Math.max(this.look.low + GAIN_STEP, Math.min(100 + 10 * GAIN_STEP, this.look.high - step * GAIN_STEP));
    this.#recolour();
  }

  nextMap(step = 1) {
    const names = Object.keys(MAPS);
    this.setMap(names[(names.indexOf(this.look.map) + step + names.length) % names.length]);
  }

  setMap(name) {
    this.look.map = name;
    setting("map", name);
    this.#recolour();
  }

  toggleHatch() {
    this.look.hatch = !this.look.hatch;
    this.#recolour();
  }

  #recolour() {
    for (const view of this.views) view.recolour();
    this.#tools();
  }

  redrawAll() {
    for (const view of this.views) view.draw();
  }

  redraw() { this.#recolour(); }

  #words() {
    const { contact, record } = this.detail;
    const sigma = contact.position_sigma_m ? ` ± ${quantity(contact.position_sigma_m, "m", 0)}` : "";
    fill(this.heading,
      h("h2", { text: contact.name }),
      h("span", { class: "number", text: time(contact.seen_utc_s ?? contact.first_frame_utc_s, { date: true }) }),
      h("span", { class: "number", text: `ATD ${contact.atd_class ? `${contact.atd_class} ` : ""}${contact.atd_confidence === null ? DASH : contact.atd_confidence.toFixed(2)}` }),
      h("span", { class: "number", text: `${position(contact.lat_deg, contact.lon_deg)}${sigma} · range ${quantity(record?.slant_range_m ?? contact.range_m, "m", 0)} · altitude ${quantity(record?.altitude_m, "m")}` }));
    this.#tools();
    drawVersions(this);
    fill(this.strip, honestyStrip(this.shown, this.shownLayer));
  }

  #tools() {
    if (this.detail) drawTools(this);
  }

  #hint() {
    drawHint(this);
  }
}
