// The bar at the top: where one is, what waits, whether what is shown is fresh; and the banners below it.

import { api } from "./api.js";
import { fill, h } from "./dom.js";
import { duration, quantity } from "./format.js";
import { listen, now, setting, state, tell } from "./state.js";

export const VIEWS = [["review", "Review", "q"], ["map", "Map", "p"], ["fleet", "Link", "f"]];

export function toggleTheme() {
  const theme = document.documentElement.dataset.theme === "night" ? "day" : "night";
  document.documentElement.dataset.theme = setting("theme", theme);
  tell("theme");
}

export function toggleType() {
  const size = document.documentElement.dataset.type === "large" ? "normal" : "large";
  document.documentElement.dataset.type = setting("type", size);
  tell("theme");
}

export function restoreLook() {
  const night = matchMedia("(prefers-color-scheme: dark)").matches ? "night" : "day";
  document.documentElement.dataset.theme = setting("theme") === "day" ? "day" : setting("theme") ?? night;
  document.documentElement.dataset.type = setting("type") ?? "normal";
}

/** The vehicle heard last, as one line. */
function linkWords(vehicles) {
  const heard = vehicles.filter((one) => one.last_heard_utc_s !== null).sort((a, b) => b.last_heard_utc_s - a.last_heard_utc_s);
  if (!heard.length) return ["no vehicle heard", true];
  const [first] = heard;
  const age_s = now() - first.last_heard_utc_s;
  const stale = age_s > state.info.stale_after_s.vehicle;
  const more = heard.length > 1 ? ` +${heard.length - 1}` : "";
  return [`${first.vehicle_id}${more}: ${duration(age_s)} ago, ${quantity(first.snr_in_db, "dB", 0)}${stale ? ", stale" : ""}`, stale];
}

/** Who one is: the way to another password, and out. */
export function account() {
  const here = location.pathname === "/password";
  const { user, role } = state.session;
  const words = `Change the password of ${user}${here ? "" : " (in another tab)"}`;
  return [
    // In a tab of its own: a remark that is not sent yet stays where it is.
    h("a", {
      class: "button", id: "to-password", href: "/password", target: here ? null : "_blank", rel: here ? null : "noopener",
      title: words, "aria-label": words, "aria-current": here ? "page" : null,
    }, h("span", { class: "key" })),
    h("button", { type: "button", title: `Log out ${user} (${role})`, on: { click: logout } }, `${user}: log out`),
  ];
}

async function logout() {
  await api.logout();
  location.assign("/login");
}

export class Bar {
  constructor(actions) {
    this.element = document.getElementById("bar");
    this.banners = document.getElementById("banners");
    this.count = h("span", { class: "count", id: "unreviewed" });
    this.link = h("span", { class: "pill number", id: "link", title: "the vehicle heard last, when, and how well" });
    this.live = h("span", { class: "pill", id: "live" });
    this.tabs = VIEWS.map(([name, title, key]) => h("button", {
      type: "button", "aria-pressed": "false", data: { view: name }, on: { click: () => tell("view", { name }) },
    }, `${title} `, h("kbd", { text: key })));
    fill(this.element,
      h("h1", {}, h("img", { src: "/static/icon.svg", alt: "", width: 26, height: 26 }), state.info.platform_id),
      h("nav", { "aria-label": "Views" }, this.tabs),
      this.count, h("span", { class: "gap" }), this.link, this.live,
      h("button", { type: "button", title: "Exports (x)", "aria-label": "Exports (x)", on: { click: actions.exports } }, "⇩"),
      h("button", { type: "button", title: "Day or night (t)", "aria-label": "Day or night theme (t)", on: { click: toggleTheme } }, "◐"),
      h("button", { type: "button", title: "Type size (z)", "aria-label": "Type size (z)", on: { click: toggleType } }, "A±"),
      h("button", { type: "button", title: "Keys (?)", "aria-label": "Keys (?)", on: { click: actions.help } }, "?"),
      account());
    listen("counts", () => this.#counts());
    listen("contact", ({ unreviewed, total }) => { Object.assign(state, { unreviewed, total }); this.#counts(); });
    listen("online", () => this.tick());
    listen("fleet", () => this.tick());
    setInterval(() => this.tick(), 1000);
    this.tick();
  }

  shows(view) {
    for (const tab of this.tabs) tab.setAttribute("aria-pressed", String(tab.dataset.view === view));
  }

  #counts() {
    fill(this.count, h("b", { class: "number", text: String(state.unreviewed) }), " to review", h("span", { class: "muted", text: ` of ${state.total}` }));
    document.title = `(${state.unreviewed}) ${state.info.platform_id} · sonarpost console`;
  }

  tick() {
    const [words, stale] = linkWords(state.fleet?.vehicles ?? []);
    this.link.textContent = words;
    this.link.classList.toggle("stale", stale || !state.online);
    this.live.textContent = state.online ? "live" : "not live";
    this.live.className = `pill ${state.online ? "good" : "bad"}`;
    document.body.dataset.online = String(state.online);
    const silent_s = (performance.now() - state.heard_ms) / 1000;
    const banners = [];
    if (state.info.training) banners.push(h("p", { id: "training", text: "TRAINING — every contact here is simulated. Nothing goes to a vehicle or to the shore." }));
    if (!state.online) banners.push(h("p", { class: "bad", id: "offline", text: `No connection to the console's server for ${duration(silent_s)}: what you see is old. Trying again …` }));
    const same = banners.map((one) => one.id).join() === [...this.banners.children].map((one) => one.id).join();
    if (same) banners.forEach((one, i) => { if (this.banners.children[i].textContent !== one.textContent) this.banners.children[i].textContent = one.textContent; });
    else fill(this.banners, banners);
  }
}
