// The console's page: puts the views together and keeps the contact on the screen true to the server.

import { api, useToken } from "./api.js";
import { Aside } from "./aside.js";
import { askForMore } from "./asking.js";
import { Bar, restoreLook, toggleTheme, toggleType } from "./bar.js";
import { ContactView } from "./contact_view.js";
import { DecisionForm } from "./decision.js";
import { ask, calmly, h, toast } from "./dom.js";
import { startEvents } from "./events.js";
import { Filters } from "./filters.js";
import { FleetView } from "./fleet_view.js";
import { keyTable, showHelp, startKeys } from "./keys.js";
import { MapView } from "./map_view.js";
import { Queue } from "./queue.js";
import { clockIs, listen, state, tell } from "./state.js";

class App {
  constructor() {
    this.view = new ContactView();
    this.decision = new DecisionForm(this.view);
    this.aside = new Aside();
    this.queue = new Queue();
    this.filters = new Filters(calmly(() => this.queue.show(this.filters.query), 120));
    listen("fleet", (fleet) => { state.fleet = fleet; }); // before anybody draws it
    this.map = new MapView();
    this.fleet = new FleetView();
    this.shown = "review";
    this.turn = 0; // of the question, counted
    this.newest = 0; // whose answer is on the screen
    this.side = h("div", { class: "panel", role: "region", "aria-label": "Decision" }, this.decision.element, this.aside.element);
    this.review = h("section", { class: "review", "aria-label": "Review" },
      h("div", { class: "side" }, this.filters.element, this.queue.element), this.view.element, this.side);
    document.getElementById("main").append(this.review, this.map.element, this.fleet.element);
    this.keys = keyTable({ app: this, queue: this.queue, view: this.view, decision: this.decision, map: this.map });
    this.bar = new Bar({ exports: () => this.exports(), help: () => this.help() });
    this.#empty();
    this.#wire();
  }

  #wire() {
    const again = calmly(() => this.load(), 5, 50);
    startKeys(this.keys, () => this.shown, { leave: () => this.escape(), send: () => this.decision.submit() });
    listen("counts", (answer) => {
      this.filters.found(answer);
      // Nobody is looking at anything yet: show the first that there is.
      if (state.selected === null && answer.matching > 0) queueMicrotask(() => this.queue.choose(0));
    });
    listen("select", ({ id }) => this.select(id));
    listen("view", ({ name }) => this.show(name));
    listen("contact", ({ contact }) => { if (contact.id === state.selected) again(); });
    for (const name of ["decision", "request", "advice", "changed"]) listen(name, ({ id }) => { if (id === state.selected) again(); });
    listen("reload", () => this.reload());
    listen("theme", () => this.view.redraw());
    listen("session", () => location.assign("/login"));
  }

  async start() {
    this.show("review");
    const asked = decodeURIComponent(location.hash.slice(1));
    await Promise.all([
      asked ? this.select(asked) : null,
      this.queue.show(this.filters.query),
      api.fleet().then((fleet) => tell("fleet", fleet)),
    ]);
    startEvents();
  }

  /** Everything anew: the stream was interrupted for longer than the server remembers. */
  async reload() {
    try {
      tell("fleet", await api.fleet());
      await Promise.all([this.queue.refresh(), this.load()]);
    } catch (error) {
      toast(error.message, { bad: true });
    }
  }

  #empty() {
    for (const part of [this.view.element, this.side]) part.classList.toggle("hidden", state.selected === null);
  }

  async select(id) {
    state.selected = id;
    history.replaceState(null, "", `#${encodeURIComponent(id)}`);
    this.queue.mark(id);
    await this.load();
  }

  /** Bring the shown contact up to date. */
  async load() {
    const id = state.selected;
    if (id === null) return;
    const turn = (this.turn += 1);
    let detail;
    try {
      detail = await api.contact(id);
    } catch (error) {
      if (error.status === 404) { state.selected = null; this.#empty(); }
      // Without an answer it is asked again, for as long as somebody wants to see it.
      if (error.status === 0) setTimeout(() => { if (id === state.selected && turn === this.turn) this.load(); }, 1000);
      else toast(error.message, { bad: true });
      return;
    }
    // A slow answer must not replace a newer one.
    if (id !== state.selected || turn < this.newest) return;
    this.newest = turn;
    this.detail = detail;
    this.#empty();
    this.decision.show(detail);
    this.aside.show(detail);
    await this.view.show(detail);
    this.decision.show(detail);
  }

  show(name) {
    this.shown = name;
    for (const [one, element] of [["review", this.review], ["map", this.map.element], ["fleet", this.fleet.element]]) element.classList.toggle("hidden", one !== name);
    this.bar.shows(name);
    if (name === "map") { this.map.load().catch((error) => toast(error.message, { bad: true })); this.map.canvas.focus(); }
    if (name === "fleet") this.fleet.draw();
    if (name === "review") { this.queue.draw(); this.view.redraw(); this.queue.list.focus(); }
  }

  async nextUnreviewed() {
    if (!(await this.queue.nextUnreviewed())) toast("Nothing else is unreviewed.");
  }

  nextLook() {
    const group = this.detail?.group ?? [];
    if (group.length < 2) { toast("There is one look at this place."); return; }
    this.select(group[(group.findIndex((row) => row.id === state.selected) + 1) % group.length].id);
  }

  search() { this.filters.search.focus(); this.filters.search.select(); }

  toggleReview() { this.filters.setReview(this.filters.review === "unreviewed" ? "" : "unreviewed"); }

  enter() {
    if (this.view.measuring.active) this.view.measuring.set().then((kept) => kept?.id && this.load());
    else this.decision.submit();
  }

  async askForMore() {
    if (this.detail) await askForMore(this.detail.contact);
  }

  theme() { toggleTheme(); }
  type() { toggleType(); }
  help() { showHelp(this.keys); }

  escape() {
    if (this.view.measuring.active) this.view.measuring.back();
    else (this.shown === "map" ? this.map.canvas : this.queue.list).focus();
  }

  async exports() {
    const formats = [["geojson", "GeoJSON, for GIS"], ["kmz", "KMZ, for Google Earth, pictures within"], ["csv", "CSV, for spreadsheets"], ["cot.xml", "Cursor-on-Target, for TAK"]];
    const links = formats.map(([format, words]) => h("a", { href: api.exportUrl(format, this.filters.query), download: "", text: words }));
    const report = this.detail ? h("a", { href: api.reportUrl(this.detail.contact.id), target: "_blank", rel: "noopener", text: `Printable report of ${this.detail.contact.name}` }) : null;
    await ask("Exports", [h("p", { text: `What the queue's filter shows: ${this.queue.rows.matching} contacts.` }), h("div", { class: "exports" }, links, report)], [{ label: "Close", value: null, primary: true }]);
  }
}

restoreLook();
try {
  [state.session, state.info] = await Promise.all([api.session(), api.info()]);
  useToken(state.session.csrf);
  clockIs(state.info.now_utc_s);
  await new App().start();
} catch (error) {
  if (error.status !== 401) toast(error.message, { bad: true });
  if (!("status" in error)) throw error;
}
