// The page: assembles the views, and keeps the displayed contact up to date.

import { api, setToken } from "./api.js";
import { ContactDetails } from "./contact_details.js";
import { ContactView } from "./contact_view.js";
import { DecisionForm } from "./decision_form.js";
import { debounce, h, showDialog, toast } from "./dom.js";
import { startEvents } from "./event_stream.js";
import { FleetView } from "./fleet_view.js";
import { Header, restoreTheme, toggleTheme, toggleTypeSize } from "./header.js";
import { markKeys } from "./keys.js";
import { Drawer, onSwipe } from "./layout.js";
import { MapView } from "./map_view.js";
import { Queue } from "./queue.js";
import { QueueFilters } from "./queue_filters.js";
import { openRequestDialog } from "./request_dialog.js";
import { loadSettings } from "./settings.js";
import { openSettings } from "./settings_dialog.js";
import { shortcutTable, showHelp, startShortcuts } from "./shortcuts.js";
import { emit, listen, setClock, setting, state } from "./state.js";
import { loadLanguage, translate } from "./texts.js";

class App {
  constructor() {
    this.view = new ContactView();
    this.decision = new DecisionForm(this.view);
    this.details = new ContactDetails();
    this.queue = new Queue();
    this.filters = new QueueFilters(debounce(() => this.queue.show(this.filters.query), 120));
    listen("fleet", (fleet) => { state.fleet = fleet; }); // first listener: the others read the state
    this.map = new MapView();
    this.fleet = new FleetView();
    this.activeView = "review";
    this.requestNumber = 0; // last request for a contact
    this.displayedNumber = 0; // request whose response is displayed
    this.panel = h("div", { class: "panel", role: "region", "aria-label": "Decision" }, this.decision.element, this.details.element);
    this.drawer = new Drawer(this.panel);
    this.review = h("section", { class: "review", "aria-label": "Review" },
      h("div", { class: "side" }, this.filters.element, this.queue.element), this.view.element, this.panel);
    onSwipe(this.view.stage, () => !this.view.zoomed && !this.view.measurement.active, (step) => this.queue.move(step));
    document.getElementById("main").append(this.review, this.map.element, this.fleet.element);
    this.keys = shortcutTable({ app: this, queue: this.queue, view: this.view, decision: this.decision, map: this.map });
    this.header = new Header({ exports: () => this.exports(), settings: () => this.settings(), help: () => this.help() });
    this.#hideWithoutContact();
    this.#addListeners();
  }

  #addListeners() {
    const reloadSoon = debounce(() => this.load(), 5, 50);
    startShortcuts(this.keys, () => this.activeView, { leave: () => this.escape(), send: () => this.decision.submit() });
    listen("counts", (response) => {
      this.filters.update(response);
      // Display the first contact if none is selected.
      if (state.selected === null && response.matching > 0) queueMicrotask(() => this.queue.choose(0));
    });
    listen("select", ({ id }) => this.select(id));
    listen("view", ({ name }) => this.show(name));
    listen("contact", ({ contact }) => { if (contact.id === state.selected) reloadSoon(); });
    for (const name of ["decision", "request", "advice", "changed"]) listen(name, ({ id }) => { if (id === state.selected) reloadSoon(); });
    listen("reload", () => this.reload());
    listen("theme", () => this.view.redraw());
    listen("session", () => location.assign("/login"));
  }

  async start() {
    this.show("review");
    const requested = decodeURIComponent(location.hash.slice(1));
    await Promise.all([
      requested ? this.select(requested) : null,
      this.queue.show(this.filters.query),
      api.fleet().then((fleet) => emit("fleet", fleet)),
    ]);
    startEvents();
  }

  /** Reload all data after a long interruption of the event stream. */
  async reload() {
    try {
      emit("fleet", await api.fleet());
      await Promise.all([this.queue.refresh(), this.load()]);
    } catch (error) {
      toast(error.message, { bad: true });
    }
  }

  #hideWithoutContact() {
    for (const part of [this.view.element, this.panel]) part.classList.toggle("hidden", state.selected === null);
  }

  async select(id) {
    state.selected = id;
    history.replaceState(null, "", `#${encodeURIComponent(id)}`);
    this.queue.mark(id);
    await this.load();
  }

  /** Update the displayed contact. */
  async load() {
    const id = state.selected;
    if (id === null) return;
    const number = (this.requestNumber += 1);
    let detail;
    try {
      detail = await api.contact(id);
    } catch (error) {
      if (error.status === 404) { state.selected = null; this.#hideWithoutContact(); }
      // Without a response, the request is repeated while the contact is selected.
      if (error.status === 0) setTimeout(() => { if (id === state.selected && number === this.requestNumber) this.load(); }, 1000);
      else toast(error.message, { bad: true });
      return;
    }
    // Discard a response that is older than the displayed one.
    if (id !== state.selected || number < this.displayedNumber) return;
    this.displayedNumber = number;
    this.detail = detail;
    this.#hideWithoutContact();
    this.decision.show(detail);
    this.details.show(detail);
    await this.view.show(detail);
    this.decision.show(detail);
  }

  show(name) {
    this.activeView = name;
    for (const [one, element] of [["review", this.review], ["map", this.map.element], ["fleet", this.fleet.element]]) element.classList.toggle("hidden", one !== name);
    this.header.setView(name);
    if (name === "map") { this.map.load().catch((error) => toast(error.message, { bad: true })); this.map.canvas.focus(); }
    if (name === "fleet") { this.fleet.render(); this.fleet.element.focus(); }
    if (name === "review") { this.queue.draw(); this.view.redraw(); this.queue.list.focus(); }
  }

  async nextUnreviewed() {
    if (!(await this.queue.nextUnreviewed())) toast("There are no other unreviewed contacts.");
  }

  nextLook() {
    const group = this.detail?.group ?? [];
    if (group.length < 2) { toast("There is only one look at this position."); return; }
    this.select(group[(group.findIndex((row) => row.id === state.selected) + 1) % group.length].id);
  }

  search() { this.filters.openSearch(); }

  toggleReview() { this.filters.setReview(this.filters.review === "unreviewed" ? "" : "unreviewed"); }

  enter() {
    if (this.view.measurement.active) this.view.measurement.setPoint().then((stored) => stored?.id && this.load());
    else this.decision.submit();
  }

  async request() {
    if (this.detail) await openRequestDialog(this.detail.contact);
  }

  toggleTheme() { toggleTheme(); }
  toggleTypeSize() { toggleTypeSize(); }
  help() { showHelp(this.keys); }
  settings() { openSettings(this.keys); }

  escape() {
    if (this.view.measurement.active) this.view.measurement.back();
    else (this.activeView === "map" ? this.map.canvas : this.queue.list).focus();
  }

  async exports() {
    const formats = [["geojson", "GeoJSON, for GIS"], ["kmz", "KMZ, for Google Earth, with images"], ["csv", "CSV, for spreadsheets"], ["cot.xml", "Cursor-on-Target, for TAK"]];
    const filter = this.filters.query;
    const progress = h("p", { class: "progress", role: "status" });
    const links = formats.map(([format, text]) => h("button", { type: "button", text, data: { export: format }, on: { click: (event) => saveExport(event.target, progress, format, filter) } }));
    const report = this.detail ? h("a", { href: api.reportUrl(this.detail.contact.id), target: "_blank", rel: "noopener", text: `Printable report of ${this.detail.contact.name}` }) : null;
    await showDialog("Exports", [h("p", { text: `Contacts of the queue filter: ${this.queue.rows.matching}.` }), h("div", { class: "exports" }, links, report), progress], [{ label: "Close", value: null, primary: true }]);
  }
}

/** Save an export as a file; the button is disabled until the server has prepared it. */
async function saveExport(button, progress, format, filter) {
  button.disabled = true;
  progress.textContent = "The server prepares the file …";
  try {
    const url = URL.createObjectURL(await api.export(format, filter));
    h("a", { href: url, download: `contacts.${format}` }).click();
    setTimeout(() => URL.revokeObjectURL(url), 60000);
    progress.textContent = `contacts.${format} is saved.`;
  } catch (error) {
    progress.textContent = `No export: ${error.message}`;
  } finally {
    button.disabled = false;
  }
}

restoreTheme();
try {
  [state.session, state.info] = await Promise.all([api.session(), api.info()]);
  setToken(state.session.csrf);
  await loadSettings(state.session.user);
  restoreTheme();
  markKeys();
  await loadLanguage(setting("language"));
  translate(document);
  setClock(state.info.now_utc_s);
  await new App().start();
} catch (error) {
  if (error.status !== 401) toast(error.message, { bad: true });
  if (!("status" in error)) throw error;
}
