// Contact view: the image with toolbar, versions and data integrity strip.

import { api } from "../base/api.js";
import { h, fill, showError, toast } from "../base/dom.js";
import { layerName, position, quantity, received, time } from "../base/format.js";
import { MAPS, autoRange, loadImage } from "../image/image_data.js";
import { startPointer } from "../image/image_pointer.js";
import { ORIENTATIONS } from "../image/image_projection.js";
import { drawTools } from "../image/image_toolbar.js";
import { ImageView, defaultViewport } from "../image/image_view.js";
import { imageFacts, qualityLine } from "./integrity_strip.js";
import { Loupe } from "../image/loupe.js";
import { compose, compositionOf, continuesOut, outlinesOf, relatedLayers, relatedVersion } from "./related_images.js";
import { MeasurementTool, measurementLine } from "../image/measurement.js";
import { drawSizePanel } from "../image/size_panel.js";
import { setting, state } from "../base/state.js";
import { t } from "../texts.js";
import { drawVersions } from "./versions_bar.js";

const GAIN_STEP = 5;
const CACHED_IMAGES = 20;
const TOOLS_REM = { above: 2.1, beside: 7.9, height: 22 }; // size of the tools above the image and beside it, and their least height there
const RECEIVED = { name: "raw", reason: "" };

/** Version beside the displayed one in a comparison: the first of the others, or null. */
const secondImage = ({ versions }, { version, compare }) => (compare && versions.find((one) => one.version !== version)) || null;

/** Slant range, or ground range where the record has no slant range. */
function rangeText(/** @type {Contact} */ contact, record) {
  const slant_m = record?.slant_range_m ?? null;
  return t(slant_m === null ? "contact_view.ground_range" : "contact_view.slant_range", { range: quantity(slant_m ?? contact.range_m, "m", 0) });
}

export class ContactView {
  constructor() {
    this.detail = null;
    this.version = null; // number of the displayed version
    this.follow = true; // display newer versions when they arrive
    this.layer = "raw";
    this.compare = false;
    this.autoGain = true;
    this.changes = 0; // number of selections and displayed contacts
    this.target = null; // selected choice whose images are being loaded
    this.cache = new Map(); // key of an image → promise
    this.display = { map: setting("map") in MAPS ? setting("map") : "grey", low: 0, high: 100, smooth: null, grid: setting("grid") !== "off", ground: setting("ground") === "on", orientation: setting("orientation") ?? "nadir" };
    this.loupeOn = false; // also without a measurement
    this.more = false; // all tools are shown
    this.#build();
    this.measurement = new MeasurementTool(() => this.#displayed(), () => this.#drawLines());
    startPointer(this);
  }

  #build() {
    const viewport = defaultViewport();
    this.canvases = [t("image.label"), t("image.compared")].map((label) => h("canvas", { role: "img", "aria-label": label }));
    this.views = this.canvases.map((canvas) => new ImageView(canvas, viewport));
    for (const view of this.views) view.display = this.display;
    this.heading = h("div", { class: "heading", role: "group", "aria-label": t("contact_view.heading") });
    this.tools = h("div", { class: "tools", role: "toolbar", "aria-label": t("tools.group") });
    this.placeholder = h("p", { class: "placeholder" });
    this.loading = h("p", { class: "loading-name", role: "status" });
    this.loupe = new Loupe(this.views[0], () => this.loupeOn || this.measurement.active);
    this.sizes = h("div", { class: "size-panel", role: "region", "aria-label": t("measure.panel") });
    this.stage = h("div", { class: "stage" }, this.canvases, this.placeholder, this.loupe.element, this.loading);
    this.versions = h("div", { class: "versions", role: "group", "aria-label": t("versions_bar.title") });
    this.imageArea = h("div", { class: "image-area" }, h("div", { class: "image-bar" }, this.tools, this.versions), this.stage);
    new ResizeObserver(() => this.#arrange()).observe(this.imageArea);
    this.strip = h("p", { class: "strip number", "aria-label": t("integrity_strip.title") });
    this.facts = h("dl", { class: "facts number" });
    this.data = h("details", { class: "image-data" }, h("summary", { text: t("integrity_strip.title") }), this.facts);
    this.element = h("section", { class: "contact", "aria-label": t("contact_view.contact") }, this.heading, this.imageArea, this.sizes, this.strip);
  }

  get shown() { return this.detail?.versions.find((one) => one.version === this.version) ?? null; }
  /** Layers of the displayed version, and the images that answer requests about the contact. */
  get layers() { return this.shown ? [RECEIVED, ...relatedLayers(this.detail)] : []; }
  get shownLayer() { return this.layers.find((one) => one.name === this.layer) ?? null; }

  get zoomed() { return this.views[0].viewport.zoom > 1; }

  #displayed() {
    const view = this.views[0];
    return { id: this.detail?.contact.id, version: this.version, layer: this.layer, image: view.image, projection: view.projection };
  }

  /**
   * Identifier, version, layer and digest of the image on the canvas; null without an image.
   *
   * A layer that is an image of its own belongs to the displayed version of the contact.
   */
  get drawn() {
    const source = this.views[0].image?.source ?? null;
    if (!source || source.id === this.detail.contact.id) return source;
    return { id: this.detail.contact.id, version: this.version, layer: this.layer, sha256: this.shown.sha256 };
  }

  /**
   * Load the images to display of a contact: newest version and raw layer, or what is selected of the displayed contact.
   *
   * Returns the argument of `commit`.
   */
  async prepare(detail) {
    const same = detail.contact.id === this.detail?.contact.id;
    const newest = detail.versions.at(-1)?.version ?? null;
    const choice = same ? this.#choice() : { version: newest, layer: "raw", follow: true, compare: this.compare };
    // The image does not change during a measurement.
    if (same && this.follow && !this.measurement.active) choice.version = newest;
    return { detail, choice, changes: this.changes, images: await this.#load(detail, choice) };
  }

  /** Display a prepared contact: heading, image, versions and strip in one step. */
  commit({ detail, choice, changes, images }) {
    const other = detail.contact.id !== this.detail?.contact.id;
    this.detail = detail;
    if (other) {
      this.autoGain = true;
      this.measurement.stop();
      Object.assign(this.views[0].viewport, defaultViewport());
    } else if (changes !== this.changes) {
      // The operator has selected another image in the meantime.
      this.#renderText();
      return;
    }
    this.changes += 1;
    this.#draw(choice, images);
  }

  #choice() { return { version: this.version, layer: this.layer, follow: this.follow, compare: this.compare, ...this.target }; }

  /** Select version, layer or comparison; the display changes when the images are loaded. */
  async #select(selected) {
    const { detail } = this;
    const choice = { ...this.#choice(), ...selected };
    this.target = choice;
    const number = (this.changes += 1);
    try {
      const images = await this.#load(detail, choice);
      if (number === this.changes) this.#draw(choice, images);
    } catch (error) {
      if (number === this.changes) this.target = null;
      toast(error.message, { bad: true });
    }
  }

  /** Display the version with a number. */
  async showVersion(number) {
    const newest = this.detail?.versions.at(-1)?.version;
    if (!this.detail?.versions.some((one) => one.version === number)) return;
    this.measurement.stop();
    await this.#select({ version: number, follow: number === newest });
  }

  async showLayer(name) {
    const layer = this.layers.find((one) => one.name === name);
    if (!layer) return;
    // The expanded image shows other seabed: the viewport of one image does not fit the other.
    if (name === "expand" || this.layer === "expand") Object.assign(this.views[0].viewport, defaultViewport());
    if (layer.reason && this.measurement.active) this.measurement.stop();
    await this.#select({ layer: name });
  }

  /** Show the first version beside the newest, or one image. */
  async toggleCompare() {
    if (this.detail) await this.#select({ compare: !this.#choice().compare });
  }

  /** Version beside the displayed one, or null. */
  comparedImage() { return secondImage(this.detail, this); }

  #image(detail, version) {
    const id = version.contact_id ?? detail.contact.id;
    const key = `${id} ${version.version} ${version.sha256}`;
    if (!this.cache.has(key)) {
      if (this.cache.size >= CACHED_IMAGES) this.cache.delete(this.cache.keys().next().value);
      const image = loadImage(
        { id, version: version.version, layer: "raw", sha256: version.sha256 },
        api.imageUrl(id, version.version),
        version.missing_fraction > 0 ? api.maskUrl(id, version.version) : null,
      );
      image.catch(() => this.cache.delete(key));
      this.cache.set(key, image);
    }
    return this.cache.get(key);
  }

  /** Load the images of a choice; null for a canvas without an image. */
  #load(detail, choice) {
    const shown = detail.versions.find((one) => one.version === choice.version);
    const related = relatedVersion(detail, choice.layer);
    const composition = compositionOf(detail, shown, choice.layer);
    return Promise.all([related ?? shown ?? null, secondImage(detail, choice)].map(async (version, index) => {
      if (index === 0 && composition) return this.#composed(detail, composition);
      return version && { image: await this.#image(detail, version), version, layer: index === 0 ? choice.layer : "raw" };
    }));
  }

  /** Load and compose the images of a layer. Its source is the image that answers the request. */
  async #composed(detail, { layer, base, factor, parts, mark, box }) {
    const [image, ...others] = await Promise.all([base, ...parts.map((one) => one.version)].map((version) => this.#image(detail, version)));
    const { source } = [image, ...others].findLast((one) => one.source.id !== detail.contact.id);
    const composed = { ...compose(image, factor, parts.map((one, index) => ({ image: others[index], box: one.box }))), source };
    return { image: composed, version: base, layer, mark: { mark, box } };
  }

  #draw(choice, images) {
    Object.assign(this, choice);
    this.target = null;
    this.canvases.forEach((canvas, index) => canvas.classList.toggle("hidden", !images[index]));
    this.placeholder.textContent = this.shown && this.detail.contact.has_image ? "" : t("contact_view.no_image");
    if (this.autoGain && images[0]) [this.display.low, this.display.high] = autoRange(images[0].image);
    this.views.forEach((view, index) => {
      if (images[index]) this.#showOn(view, images[index]);
      else view.show(null, {});
    });
    this.#arrange();
    const shows = this.drawn ? `${this.drawn.id} ${this.drawn.version} ${this.drawn.layer}` : "";
    // A region is drawn on one image.
    if (this.canvases[0].dataset.shows !== shows) document.querySelector(".region-layer")?.remove();
    this.canvases[0].dataset.shows = shows;
    this.#renderText();
    this.#drawLines();
  }

  /** Put the tools beside the image or above it: where they leave more room for it. */
  #arrange() {
    const [view] = this.views;
    const { clientWidth: width, clientHeight: height } = this.imageArea;
    if (!view.image || width === 0) return;
    const count = this.comparedImage() ? 2 : 1;
    const rem_px = parseFloat(getComputedStyle(document.documentElement).fontSize);
    const { above, beside: column, height: least } = TOOLS_REM;
    const beside = height >= least * rem_px && view.scaleOn((width - column * rem_px) / count, height) > view.scaleOn(width / count, height - above * rem_px);
    this.imageArea.classList.toggle("beside", beside);
    this.redrawAll();
  }

  /** Dim the image while another contact is loaded; null ends it. */
  showLoading(name) {
    this.stage.classList.toggle("loading", name !== null);
    this.loading.textContent = name === null ? "" : t("contact_view.loading", { name });
  }

  #showOn(view, { image, version, layer, mark = null }) {
    const known = version.pixel_along_m && version.pixel_across_m;
    // A layer may have more pixels than the image, for the same area.
    const scale = known ? {
      along_m: (version.pixel_along_m * version.height_px) / image.height,
      across_m: (version.pixel_across_m * version.width_px) / image.width,
    } : null;
    const title = `${t("contact_view.version", { version: version.version })} · ${layerName(version, layer)}${version.complete ? "" : ` · ${received(version)}`}`;
    const record = this.detail.record ?? {};
    // A layer may have more pixels than the image; the mark is in pixels of the image. The place of a region alone is unknown.
    const same = version.width_px === image.width && version.height_px === image.height && !(version.contact_id && this.layer === "region");
    const geometry = {
      scale, range_axis: version.range_axis, ...(mark ?? { mark: same ? version.mark : null, box: same ? version.box : null }),
      altitude_m: record.altitude_m ?? null, heading_deg: record.heading_deg ?? null, side: record.channel ?? null,
    };
    view.show(image, { geometry, title });
  }

  #drawLines() {
    const current = Object.values(this.detail?.size ?? {}).map((one) => one?.measurement);
    const stored = (this.detail?.measurements ?? []).filter((one) => current.includes(one.id) && one.version === this.version && one.layer === this.layer).map(measurementLine);
    this.views[0].lines = [...outlinesOf(this.detail && compositionOf(this.detail, this.shown, this.layer)), ...(this.measurement.active ? [] : stored), ...this.measurement.lines()];
    this.views[0].crosshair = this.measurement.active && !this.measurement.result ? this.measurement.crosshair : null;
    this.views[0].draw();
    this.canvases[0].classList.toggle("measures", this.measurement.active);
    this.showLoupe(this.measurement.active && !this.measurement.result ? this.measurement.crosshair : null);
    drawSizePanel(this, this.sizes);
  }

  /** Show the loupe at [row, column], or hide it (null). */
  showLoupe(point) { this.loupe.show(point); }

  /** Measure a kind, or the next one; show the reason if measurements are locked. */
  startMeasurement(kind = null) {
    const reason = this.measurementLock();
    if (reason) {
      toast(t("measure.locked", { reason }), { bad: true });
      return;
    }
    if (kind) this.measurement.start(kind);
    else this.measurement.next();
    this.#drawTools();
    this.canvases[0].focus();
  }

  /** Withdraw a stored measurement; it stays in the list of measurements and in the audit. */
  withdraw(measurement) {
    return api.withdrawMeasurement(this.detail.contact.id, measurement).then(() => toast(t("measure.withdrawn")), showError);
  }

  /** Reason why measurements are locked; empty if they are not. */
  measurementLock() {
    if (!this.shown) return t("measure.no_image");
    if (!state.session.may.measure) return t("measure.no_permission");
    if (this.shownLayer?.reason) return this.shownLayer.reason;
    if (!this.views[0].scale) return t("measure.no_scale");
    return "";
  }

  zoom(factor) {
    if (continuesOut(this, factor)) {
      this.showLayer("expand");
      return;
    }
    this.views[0].zoom(factor);
    this.redrawAll();
  }

  fit() {
    Object.assign(this.views[0].viewport, defaultViewport());
    this.redrawAll();
  }

  pan(across, along) {
    this.views[0].pan(across, along);
    this.redrawAll();
  }

  /** Make the image brighter (1) or darker (-1); 0 selects automatic gain. */
  changeGain(step) {
    if (step === 0) {
      this.autoGain = true;
      const { image } = this.views[0];
      if (image) [this.display.low, this.display.high] = autoRange(image);
    } else {
      this.autoGain = false;
      const { display } = this;
      display.high = Math.max(display.low + GAIN_STEP, Math.min(100 + 10 * GAIN_STEP, display.high - step * GAIN_STEP));
    }
    this.#applyColours();
  }

  /** Show or hide the tools that are used less: grid, ground range, interpolation, loupe, colours. */
  toggleMore() {
    this.more = !this.more;
    this.#drawTools();
  }

  toggleGrid() {
    this.display.grid = !this.display.grid;
    setting("grid", this.display.grid ? "on" : "off");
    this.#applyColours();
  }

  toggleSmooth() {
    this.display.smooth = !this.views[0].smooth;
    this.#applyColours();
  }

  /** Display slant range or ground range. */
  toggleGround() {
    if (!this.views[0].projection?.convertible) {
      toast(t("image.no_ground"), { bad: true });
      return;
    }
    this.display.ground = !this.display.ground;
    setting("ground", this.display.ground ? "on" : "off");
    this.#applyColours();
  }

  setOrientation(name) {
    this.display.orientation = name;
    setting("orientation", name);
    this.#applyColours();
  }

  nextOrientation() {
    const { projection } = this.views[0];
    if (!projection) return;
    let index = ORIENTATIONS.indexOf(projection.orientation);
    do index = (index + 1) % ORIENTATIONS.length;
    while (!projection.orientable(ORIENTATIONS[index]));
    this.setOrientation(ORIENTATIONS[index]);
  }

  toggleLoupe() {
    this.loupeOn = !this.loupeOn;
    if (!this.loupeOn && !this.measurement.active) this.showLoupe(null);
    this.#drawTools();
  }

  setMap(name) {
    this.display.map = name;
    setting("map", name);
    this.#applyColours();
  }

  #applyColours() {
    for (const view of this.views) view.applyColours();
    this.#drawTools();
  }

  redrawAll() {
    for (const view of this.views) view.draw();
  }

  redraw() { this.#applyColours(); }

  #renderText() {
    const { contact, record } = this.detail;
    const sigma = contact.position_sigma_m ? ` ± ${quantity(contact.position_sigma_m, "m", 0)}` : "";
    const image = relatedVersion(this.detail, this.layer) ?? this.shown;
    fill(this.heading,
      h("h2", { text: contact.name }),
      h("span", { class: "number", text: time(contact.seen_utc_s ?? contact.first_frame_utc_s, { date: true }) }),
      h("span", { class: "number", text: `${position(contact.lat_deg, contact.lon_deg)}${sigma}` }),
      h("span", { class: "number", text: rangeText(contact, record) }),
      h("span", { class: "number", text: t("contact_view.altitude", { altitude: quantity(record?.altitude_m, "m") }) }));
    this.#drawTools();
    drawVersions(this);
    fill(this.strip, qualityLine(image, contact));
    fill(this.facts, imageFacts(image));
    this.data.classList.toggle("hidden", image === null);
  }

  #drawTools() {
    if (this.detail) drawTools(this);
  }
}
