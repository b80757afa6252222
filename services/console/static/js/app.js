// The page: assembles the views, and keeps the displayed contact up to date.

import { api, setToken } from "./base/api.js";
import { ActionQueue } from "./base/actions.js";
import { ContactDetails } from "./contact/contact_details.js";
import { ContactLoader } from "./contact/contact_loader.js";
import { ContactView } from "./contact/contact_view.js";
import { DecisionForm } from "./decision/decision_form.js";
import { debounce, h, toast } from "./base/dom.js";
import { EmptyView } from "./shell/empty_view.js";
import { startEvents } from "./base/event_stream.js";
import { openExportDialog } from "./shell/export_dialog.js";
import { FleetView } from "./views/fleet_view.js";
import { Header, restoreTheme, toggleTheme, toggleTypeSize } from "./shell/header.js";
import { registerServiceWorker } from "./base/installation.js";
import { markKeys } from "./base/keys.js";
import { KnownObject } from "./contact/known_object.js";
import { Drawer, onSwipe } from "./base/layout.js";
import { MapView } from "./map/map_view.js";
import { MissionView } from "./views/mission_view.js";
import { openObject, watchObject } from "./views/object_view.js";
import { Queue } from "./queue/queue.js";
import { QueueFilters } from "./queue/queue_filters.js";
import { startRegion } from "./requests/region_request.js";
import { RequestButtons } from "./requests/request_buttons.js";
import { openRequestDialog } from "./requests/request_dialog.js";
import { loadSettings } from "./base/settings.js";
import { openSettings } from "./shell/settings_dialog.js";
import { shortcutTable, showHelp, startShortcuts } from "./base/shortcuts.js";
import { emit, listen, setClock, setting, state } from "./base/state.js";
import { StatusLine } from "./shell/status_line.js";
import { loadLanguage, t, translate } from "./texts.js";

const PREFETCHED_ROWS = 3;
const FAILURE_MS = 1000; // a verdict key in this time after a failed change of contact was meant for the other contact

class App {
  constructor() {
    this.view = new ContactView();
    this.loader = new ContactLoader((detail) => this.view.prepare(detail));
    this.actions = new ActionQueue();
    this.goal = null; // identifier of the contact that is being loaded for display
    this.failure = { text: "", dropped: 0, time_ms: -Infinity }; // last contact that could not be loaded
    this.supersede = () => {}; // ends waiting for the goal
    this.status = new StatusLine(() => this.undo());
    this.decision = new DecisionForm(this.view, this.status, (name, hold) => this.#pressed(name, hold));
    this.details = new ContactDetails();
    this.known = new KnownObject();
    this.requests = new RequestButtons(() => this.request());
    this.queue = new Queue();
    this.filters = new QueueFilters(debounce(() => this.queue.show(this.filters.query), 120));
    listen("fleet", (fleet) => { state.fleet = fleet; }); // first listener: the others read the state
    this.map = new MapView(() => this.actions.add(() => this.request()));
    this.fleet = new FleetView();
    this.mission = new MissionView();
    this.empty = new EmptyView();
    this.activeView = "review";
    this.requestNumber = 0; // last request for a contact
    this.displayedNumber = 0; // request whose response is displayed
    this.panel = h("div", { class: "panel", role: "region", "aria-label": t("app.decision") }, this.decision.element, this.requests.element, this.known.element, this.details.element);
    this.drawer = new Drawer(this.panel);
    this.review = h("section", { class: "review", "aria-label": t("app.review") },
      h("div", { class: "side" }, this.filters.element, this.queue.element), this.view.element, this.panel, this.empty.element);
    onSwipe(this.view.stage, () => !this.view.zoomed && !this.view.measurement.active, (step) => this.queue.move(step));
    document.getElementById("main").append(this.review, this.map.element, this.fleet.element, this.mission.element);
    this.keys = shortcutTable({ app: this, queue: this.queue, view: this.view, decision: this.decision, map: this.map });
    this.header = new Header({ exports: () => this.exports(), settings: () => this.settings(), help: () => this.help() });
    this.#hideWithoutContact();
    watchObject();
    this.#addListeners();
  }

  #addListeners() {
    const reloadSoon = debounce(() => this.load(), 5, 50);
    startShortcuts(this.keys, () => this.activeView, { leave: () => this.escape(), send: () => this.submit() });
    listen("counts", (response) => {
      this.filters.update(response);
      // Display the first contact if none is selected.
      if (state.selected === null && this.goal === null && response.matching > 0) queueMicrotask(() => this.queue.move(1));
    });
    listen("select", ({ id, name }) => this.select(id, name));
    listen("move", ({ step }) => this.#go((id) => this.queue.rowAfter(id, step)));
    listen("view", ({ name }) => this.show(name));
    const changed = (id) => {
      this.loader.forget(id);
      if (id === state.selected) reloadSoon();
    };
    listen("contact", ({ contact }) => changed(contact.id));
    for (const name of ["decision", "request", "advice", "changed"]) listen(name, ({ id }) => changed(id));
    // Without events, what was loaded in advance can be old.
    listen("online", () => this.loader.clear());
    listen("region", () => this.region());
    listen("reload", () => { this.loader.clear(); this.reload(); });
    listen("theme", () => this.view.redraw());
    listen("session", () => location.assign("/login"));
  }

  async start() {
    this.show("review");
    const requested = decodeURIComponent(location.hash.slice(1));
    if (requested) this.select(requested);
    await Promise.all([
      this.status.start(),
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
      this.failure = { text: t("app.not_loaded", { name: row?.name ?? t("app.next_contact"), reason: error.message }), dropped: 0, time_ms: performance.now() };
      this.#drop(this.actions.clear());
      // The address of the page can name an unknown contact.
      if (state.selected === null && error.status === 404 && this.queue.rows.matching > 0) queueMicrotask(() => this.queue.move(1));
      return false;
    }
  }

  /** Report keys that were meant for a contact that could not be loaded. */
  #drop(count) {
    this.failure.dropped += count;
    const { text, dropped } = this.failure;
    toast(dropped ? `${text} ${t("app.dropped", { count: dropped })}` : text, { bad: true });
  }

  #endLoading() {
    this.goal = null;
    this.supersede = () => {};
    this.view.showLoading(null);
  }

  #display({ detail, prepared, stale = false }) {
    const { id } = detail.contact;
    this.#endLoading();
    state.selected = id;
    this.requestNumber += 1;
    this.displayedNumber = this.requestNumber;
    this.detail = detail;
    this.#hideWithoutContact();
    this.view.commit(prepared);
    this.decision.show(detail);
    this.known.show(detail);
    this.details.show(detail);
    this.requests.show(detail);
    this.queue.mark(id);
    history.replaceState(null, "", `#${encodeURIComponent(id)}`);
    if (state.online) this.loader.prefetch(this.queue.following(id, PREFETCHED_ROWS).map((row) => row.id));
    if (stale) this.load();
  }

  /** Update the displayed contact. */
  async load() {
    const id = state.selected;
    if (id === null) return;
    const number = (this.requestNumber += 1);
    let detail;
    let prepared;
    try {
      detail = await api.contact(id);
      prepared = await this.view.prepare(detail);
      await nextFrame();
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
    this.view.commit(prepared);
    this.decision.show(detail);
    this.known.show(detail);
    this.details.show(detail);
    this.requests.show(detail);
  }

  show(name) {
    this.activeView = name;
    for (const [one, element] of [["review", this.review], ["map", this.map.element], ["fleet", this.fleet.element], ["mission", this.mission.element]]) element.classList.toggle("hidden", one !== name);
    this.header.setView(name);
    if (name === "map") { this.map.load().catch((error) => toast(error.message, { bad: true })); this.map.focus(); }
    if (name === "fleet") { this.fleet.render(); this.fleet.element.focus(); }
    if (name === "mission") { this.mission.load(); this.mission.element.focus(); }
    if (name === "review") { this.queue.draw(); this.view.redraw(); this.queue.list.focus(); }
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
    if (performance.now() - this.failure.time_ms < FAILURE_MS) this.#drop(1);
    else if (this.decision.isComment) this.choose(name);
    else this.actions.add(() => this.#decide(() => this.decision.decide(name)));
  }

  /** Select a verdict, which Enter sends with class and remark. */
  choose(name) {
    this.actions.add(() => this.decision.select(name));
  }

  submit() {
    this.actions.add(() => this.#decide(() => this.decision.submit()));
  }

  async #decide(send) {
    if (send()) await this.#open((id) => this.#nextUnreviewed(id));
  }

  /** A verdict button (`name`), or the send button (null). */
  #pressed(name, hold) {
    if (name === null) this.submit();
    else if (hold) this.choose(name);
    else this.decide(name);
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

  openObject() {
    if (this.detail) openObject(this.detail.contact);
  }

  search() { this.filters.openSearch(); }

  toggleReview() { this.filters.setReview(this.filters.review === "to_do" ? "" : "to_do"); }

  enter() {
    if (this.view.measurement.active) this.view.measurement.setPoint().then((stored) => stored?.id && this.load());
    else this.submit();
  }

  region() { if (this.detail) startRegion(this.view, this.detail); }

  async request() {
    if (this.detail) await openRequestDialog(this.detail.contact);
  }

  toggleTheme() { toggleTheme(); }
  toggleTypeSize() { toggleTypeSize(); }
  help() { showHelp(this.keys); }
  settings() { openSettings(this.keys); }

  escape() {
    if (this.view.measurement.active) this.view.measurement.back();
    else if (this.activeView === "map") this.map.escape();
    else this.queue.list.focus();
  }

  exports() { return openExportDialog(this.filters.query, this.queue.rows.matching, this.detail?.contact ?? null); }
}

/** The next animation frame; at once in a page that is not visible, which has none. */
const nextFrame = () => new Promise((resolve) => { if (document.hidden) resolve(); else requestAnimationFrame(resolve); });

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
  registerServiceWorker();
} catch (error) {
  if (error.status !== 401) toast(error.message, { bad: true });
  if (!("status" in error)) throw error;
}
