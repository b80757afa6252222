// The page: assembles the views, and keeps the displayed contact up to date.

import { api, setToken } from "./base/api.js";
import { ActionQueue } from "./base/actions.js";
import { ContactDetails } from "./contact/contact_details.js";
import { ContactLoader } from "./contact/contact_loader.js";
import { ContactView } from "./contact/contact_view.js";
import { DecisionForm } from "./decision/decision_form.js";
import { debounce, h, notUpdated, showError, toast } from "./base/dom.js";
import { EmptyView } from "./shell/empty_view.js";
import { startEvents } from "./base/event_stream.js";
import { openExportDialog } from "./shell/export_dialog.js";
import { FleetView } from "./views/fleet_view.js";
import { Header, restoreTheme } from "./shell/header.js";
import { registerServiceWorker } from "./base/installation.js";
import { KnownObject } from "./contact/known_object.js";
import { Drawer, onSwipe } from "./base/layout.js";
import { MapView } from "./map/map_view.js";
import { watchObject } from "./views/object_view.js";
import { Queue } from "./queue/queue.js";
import { QueueFilters } from "./queue/queue_filters.js";
import { startRegion } from "./requests/region_request.js";
import { RequestButtons } from "./requests/request_buttons.js";
import { loadSettings } from "./base/settings.js";
import { openSettings } from "./shell/settings_dialog.js";
import { shortcutTable, showHelp, startShortcuts, switchKeys } from "./base/shortcuts.js";
import { emit, listen, setClock, setting, state } from "./base/state.js";
import { StatusLine } from "./shell/status_line.js";
import { loadLanguage, t, translate } from "./texts.js";

const PREFETCHED_ROWS = 3;

class App {
  constructor() {
    this.view = new ContactView();
    this.loader = new ContactLoader((detail) => this.view.prepare(detail));
    this.actions = new ActionQueue();
    this.goal = null; // identifier of the contact that is being loaded for display
    this.supersede = () => {}; // ends waiting for the goal
    this.status = new StatusLine(() => this.undo());
    this.decision = new DecisionForm(this.view, this.status, (name) => this.decide(name));
    this.details = new ContactDetails();
    this.known = new KnownObject();
    this.requests = new RequestButtons();
    this.queue = new Queue();
    this.filters = new QueueFilters(debounce(() => this.#showQueue(), 120), () => this.queue.showGrid(!this.queue.grid));
    listen("fleet", (fleet) => { state.fleet = fleet; }); // first listener: the others read the state
    this.map = new MapView();
    this.fleet = new FleetView();
    this.empty = new EmptyView();
    this.activeView = "review";
    this.requestNumber = 0; // last request for a contact
    this.displayedNumber = 0; // request whose response is displayed
    this.panel = h("div", { class: "panel", role: "region", "aria-label": t("app.decision") }, this.decision.element, this.requests.element, this.known.element, this.view.data, this.details.element);
    this.drawer = new Drawer(this.panel);
    this.review = h("section", { class: "review", "aria-label": t("header.view.review") },
      h("div", { class: "side" }, this.filters.element, this.queue.element), this.view.element, this.panel, this.empty.element);
    onSwipe(this.view.stage, () => !this.view.zoomed && !this.view.measurement.active, (step) => this.queue.move(step));
    document.getElementById("main").append(this.review, this.map.element, this.fleet.element);
    this.keys = shortcutTable({ app: this, queue: this.queue, view: this.view, decision: this.decision, map: this.map });
    this.header = new Header({ exports: () => this.exports(), settings: () => this.settings(), help: () => this.help() });
    this.#hideWithoutContact();
    watchObject();
    this.#addListeners();
  }

  #addListeners() {
    const reloadSoon = debounce(() => this.load(), 5, 50);
    startShortcuts(this.keys, () => (this.activeView === "review" && this.queue.grid ? "grid" : this.activeView), () => this.escape());
    listen("list", (response) => {
      this.filters.update(response);
      // Display the first contact if none is selected.
      if (state.selected === null && this.goal === null && response.matching > 0) queueMicrotask(() => this.queue.move(1));
    });
    listen("select", ({ id, name }) => {
      this.queue.showGrid(false);
      this.select(id, name);
    });
    listen("grid", () => {
      this.review.classList.toggle("grid", this.queue.grid);
      this.decision.guard.restart();
    });
    listen("show_all", () => this.filters.reset());
    listen("undelivered", () => { this.show("review"); this.filters.setReview("undelivered"); });
    listen("move", ({ step }) => this.#go((id) => this.queue.rowAfter(id, step)));
    listen("view", ({ name }) => this.show(name));
    listen("contact", ({ contact }) => {
      this.loader.forget(contact.id);
      const shown = this.detail?.contact;
      // The displayed contact has the other looks at its object.
      if (shown && (shown.id === contact.id || (shown.object !== null && shown.object === contact.object))) reloadSoon();
    });
    // Without events, what was loaded in advance can be old.
    listen("online", () => this.loader.clear());
    listen("region", () => this.region());
    listen("reload", () => { this.loader.clear(); this.reload(); });
    listen("theme", () => this.view.redraw());
    listen("session", () => location.assign("/login?ended"));
    addEventListener("popstate", ({ state: entry }) => this.#goBack(entry ?? {}));
  }

  async start() {
    const requested = addressed();
    if (history.state === null) history.replaceState({ view: "review", id: requested || null }, "");
    this.#draw(history.state.view);
    if (requested) this.select(requested);
    await Promise.all([this.status.start().catch(notUpdated), this.#showQueue(), this.#loadFleet().catch(notUpdated)]);
    if (this.queue.rows.matching === 0 && state.counts.total > 0) this.filters.leaveEmptyToDo();
    const { latest, restored } = this.decision.drafts;
    if (latest) this.status.draftsRestored(latest, restored.size);
    startEvents();
  }

  #showQueue() {
    return this.queue.show(this.filters.query).catch(notUpdated);
  }

  async #loadFleet() { emit("fleet", await api.fleet()); }

  /** Reload all data after a long interruption of the event stream. */
  reload() {
    return Promise.all([this.#loadFleet(), this.queue.refresh(), this.load()]).catch(notUpdated);
  }

  #hideWithoutContact() {
    for (const part of [this.view.element, this.panel]) part.classList.toggle("hidden", state.selected === null);
    this.decision.guard.restart();
  }

  select(id, name = id) {
    this.#go(() => ({ id, name }));
  }

  /** Display the contact that `find(id)` returns for the displayed one. A step that follows at once replaces it. */
  #go(find) {
    if (this.actions.empty) this.supersede();
    this.actions.add(() => this.#open(find));
  }

  /**
   * Load a contact with its image, then change row, heading, form and image in one animation frame.
   *
   * Returns whether the contact is displayed. If it could not be loaded, nothing changes, and waiting actions are
   * dropped: they were meant for this contact.
   */
  async #open(find) {
    let row = null;
    try {
      row = await find(this.goal ?? state.selected);
      if (row === null || row.id === state.selected) {
        this.#endLoading();
        return row !== null;
      }
      this.goal = row.id;
      this.view.showLoading(row.name);
      const superseded = new Promise((resolve) => { this.supersede = () => resolve(null); });
      const loaded = await Promise.race([this.loader.load(row.id), superseded]);
      if (loaded === null) return false;
      await nextFrame();
      this.#display(loaded);
      return true;
    } catch (error) {
      this.#endLoading();
      this.actions.clear();
      this.decision.guard.restart();
      toast(t("app.not_loaded", { name: row?.name ?? t("app.next_contact"), reason: error.message }), { bad: true });
      // The address of the page can name an unknown contact.
      if (state.selected === null && error.status === 404 && this.queue.rows.matching > 0) queueMicrotask(() => this.queue.move(1));
      return false;
    }
  }

  #endLoading() {
    this.goal = null;
    this.supersede = () => {};
    this.view.showLoading(null);
  }

  #display({ detail, prepared, stale }) {
    const { id } = detail.contact;
    this.loader.forget(id);
    this.#endLoading();
    if (state.selected !== null) document.querySelector("#toasts .bad")?.remove(); // it was about the contact before
    state.selected = id;
    this.requestNumber += 1;
    this.#render(detail, prepared, this.requestNumber);
    this.#hideWithoutContact();
    this.queue.mark(id).catch(showError);
    this.#remember();
    if (state.online) this.loader.prefetch(this.queue.following(id, PREFETCHED_ROWS).map((row) => row.id));
    if (stale) this.load();
  }

  /** Update the displayed contact. */
  async load() {
    const id = state.selected;
    if (id === null) return;
    const number = (this.requestNumber += 1);
    // A response is discarded if it is older than the displayed one.
    const outdated = () => id !== state.selected || number < this.displayedNumber;
    let detail, prepared;
    try {
      detail = await api.contact(id);
      prepared = await this.view.prepare(detail);
      await nextFrame();
    } catch (error) {
      if (outdated()) return;
      if (error.status === 404) { state.selected = null; this.#hideWithoutContact(); }
      notUpdated(error);
      return;
    }
    if (!outdated()) this.#render(detail, prepared, number);
  }

  #render(detail, prepared, /** @type {number} */ number) {
    this.displayedNumber = number;
    this.detail = detail;
    this.view.commit(prepared);
    for (const part of [this.decision, this.known, this.details, this.requests]) part.show(detail);
  }

  show(name) {
    this.#draw(name);
    this.#remember();
  }

  /** Add the displayed view and contact to the history of the browser, unless it is there. */
  #remember() {
    const entry = { view: this.activeView, id: state.selected };
    const { view, id } = history.state ?? { view: entry.view, id: null };
    if (view === entry.view && id === entry.id) return;
    const address = entry.id === null ? null : `#${encodeURIComponent(entry.id)}`;
    // The first contact does not add an entry to that of the page.
    if (view === entry.view && id === null) history.replaceState(entry, "", address);
    else history.pushState(entry, "", address);
  }

  /** Display an entry of the history; one without view and contact is an address that the user has changed. */
  #goBack({ view = "review", id = addressed() }) {
    this.#draw(view);
    if (id && id !== state.selected) this.select(id);
  }

  #draw(name) {
    this.activeView = name;
    for (const [one, element] of [["review", this.review], ["map", this.map.element], ["fleet", this.fleet.element]]) element.classList.toggle("hidden", one !== name);
    this.header.setView(name);
    if (name === "map") { this.map.load().catch(notUpdated); this.map.focus(); }
    if (name === "fleet") { this.fleet.render(); this.fleet.element.focus(); }
    if (name === "review") { this.queue.draw(); this.view.redraw(); this.queue.list.focus(); }
    this.decision.guard.restart();
  }

  nextUnreviewed() {
    this.#go((id) => this.#nextUnreviewed(id));
  }

  async #nextUnreviewed(id) {
    const row = await this.queue.nextUnreviewed(id, this.decision.sending);
    if (!row) toast(t("app.no_unreviewed"));
    return row;
  }

  /** Send a verdict on the displayed contact, and display the next one without a decision. */
  decide(name) {
    // A verdict is for the contact in sight: it does not wait until another one is displayed.
    if (this.actions.running) this.decision.flash();
    else this.actions.add(async () => { if (await this.decision.decide(name)) await this.#open((id) => this.#nextUnreviewed(id)); });
  }

  /** Undo the last decision of the user, and display its contact. */
  undo() {
    this.actions.add(async () => {
      await this.decision.settled();
      let last;
      try {
        last = await api.lastDecision();
      } catch (error) {
        toast(error.message, { bad: true });
        return;
      }
      if (!last.decision) toast(t("app.nothing_to_undo"));
      else if (await this.#open(() => last.contact)) await this.decision.undo(last.decision);
    });
  }

  nextLook() {
    const group = this.detail?.group ?? [];
    if (group.length < 2) { toast(t("app.one_look")); return; }
    const next = group[(group.findIndex((row) => row.id === state.selected) + 1) % group.length];
    this.select(next.id, next.name);
  }

  search() { this.filters.openSearch(); }

  enter() {
    if (this.view.measurement.active) this.view.measurement.setPoint();
  }

  region() { if (this.detail) startRegion(this.view, this.detail); }

  request() { return this.requests.open(); }

  help() { showHelp(this.keys); }
  settings() { openSettings(); }

  escape() {
    if (this.view.measurement.active) this.view.measurement.back();
    else if (this.activeView === "map") this.map.focus();
    else if (this.queue.grid) this.queue.showGrid(false);
    else this.queue.list.focus();
  }

  exports() { return openExportDialog(this.filters.query, this.detail?.contact ?? null); }
}

/** Identifier of a contact in the address of the page, which the user can have changed; empty without one. */
const addressed = () => new URLSearchParams(`id=${location.hash.slice(1)}`).get("id");

/** The next animation frame; at once in a page that is not visible, which has none. */
const nextFrame = () => new Promise((resolve) => { if (document.hidden) resolve(); else requestAnimationFrame(resolve); });

restoreTheme();
try {
  [state.session, state.info] = await Promise.all([api.session(), api.info()]);
  setToken(state.session.csrf);
  await loadSettings(state.session.user);
  restoreTheme();
  switchKeys();
  await loadLanguage(setting("language"));
  translate(document);
  setClock(state.info.now_utc_s);
  await new App().start();
  registerServiceWorker();
} catch (error) {
  if (error.status !== 401) toast(error.message, { bad: true });
  // Without a response, the page is empty: it is loaded again.
  if (error.status === 0) setTimeout(() => location.reload(), 3000);
  if (!("status" in error)) throw error;
}
