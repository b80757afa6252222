// The header: views, number of unreviewed contacts, link state; and the banners below it.

import { api } from "./api.js";
import { fill, h } from "./dom.js";
import { duration, quantity } from "./format.js";
import { opener } from "./layout.js";
import { emit, listen, now, setting, state } from "./state.js";
import { t } from "./texts.js";

export const VIEWS = [["review", "Review", "q"], ["map", "Map", "p"], ["fleet", "Link", "f"]];

export function setTheme(theme) {
  document.documentElement.dataset.theme = setting("theme", theme);
  emit("theme");
}

export function setTypeSize(size) {
  document.documentElement.dataset.type = setting("type", size);
  emit("theme");
}

export const toggleTheme = () => setTheme(document.documentElement.dataset.theme === "night" ? "day" : "night");
export const toggleTypeSize = () => setTypeSize(document.documentElement.dataset.type === "large" ? "normal" : "large");

export function restoreTheme() {
  const preferred = matchMedia("(prefers-color-scheme: dark)").matches ? "night" : "day";
  document.documentElement.dataset.theme = setting("theme") === "day" ? "day" : setting("theme") ?? preferred;
  document.documentElement.dataset.type = setting("type") ?? "normal";
}

/** The vehicle with the latest frame as text, and whether its link is stale. */
function linkText(vehicles) {
  const linked = vehicles.filter((one) => one.last_heard_utc_s !== null).sort((a, b) => b.last_heard_utc_s - a.last_heard_utc_s);
  if (!linked.length) return ["no frame received", true];
  const [first] = linked;
  const age_s = now() - first.last_heard_utc_s;
  const stale = age_s > state.info.stale_after_s.vehicle;
  const more = linked.length > 1 ? ` +${linked.length - 1}` : "";
  return [`${first.vehicle_id}${more}: ${duration(age_s)} ago, ${quantity(first.snr_in_db, "dB", 0)}${stale ? ", stale" : ""}`, stale];
}

/** Buttons for password change and log-out. */
export function accountButtons() {
  const onPasswordPage = location.pathname === "/password";
  const { user, role } = state.session;
  const label = `Change the password of ${user}${onPasswordPage ? "" : " (in another tab)"}`;
  return [
    // The page opens in another tab, so that an unsent remark is kept.
    h("a", {
      class: "button", id: "to-password", href: "/password", target: onPasswordPage ? null : "_blank", rel: onPasswordPage ? null : "noopener",
      title: label, "aria-label": label, "aria-current": onPasswordPage ? "page" : null,
    }, h("span", { class: "key" })),
    h("button", { type: "button", title: `Log out ${user} (${role})`, on: { click: logout } }, `${user}: log out`),
  ];
}

async function logout() {
  await api.logout();
  location.assign("/login");
}

export class Header {
  constructor(actions) {
    this.element = document.getElementById("bar");
    this.banners = document.getElementById("banners");
    this.count = h("span", { class: "count", id: "unreviewed" });
    this.link = h("span", { class: "pill number", id: "link", title: "vehicle with the latest frame, age, SNR" });
    this.live = h("span", { class: "pill", id: "live" });
    this.tabs = VIEWS.map(([name, title, key]) => h("button", {
      type: "button", "aria-pressed": "false", data: { view: name }, on: { click: () => emit("view", { name }) },
    }, `${title} `, h("kbd", { text: key })));
    const menu = h("div", { class: "menu-items" },
      h("nav", { "aria-label": "Views" }, this.tabs),
      h("button", { type: "button", title: "Exports (x)", "aria-label": "Exports (x)", on: { click: actions.exports } }, "⇩"),
      h("button", { type: "button", title: "Day or night (t)", "aria-label": "Day or night theme (t)", on: { click: toggleTheme } }, "◐"),
      h("button", { type: "button", title: "Type size (z)", "aria-label": "Type size (z)", on: { click: toggleTypeSize } }, "A±"),
      h("button", { type: "button", id: "settings", title: `${t("settings.title")} (;)`, "aria-label": `${t("settings.title")} (;)`, on: { click: actions.settings } }, "⚙"),
      h("button", { type: "button", title: "Keys (?)", "aria-label": "Keys (?)", on: { click: actions.help } }, "?"),
      accountButtons());
    const menuButton = h("button", { type: "button", class: "menu-button", "aria-label": t("layout.menu"), title: t("layout.menu"), text: "☰" });
    const { close } = opener(menuButton, menu);
    menu.addEventListener("click", (event) => { if (event.target.closest("button, a")) close(); });
    fill(this.element,
      h("h1", {}, h("img", { src: "/static/icon.svg", alt: "", width: 26, height: 26 }), state.info.platform_id),
      this.count, h("span", { class: "gap" }), this.link, this.live, menuButton, menu);
    listen("counts", () => this.#renderCounts());
    listen("contact", ({ unreviewed, total }) => { Object.assign(state, { unreviewed, total }); this.#renderCounts(); });
    listen("online", () => this.render());
    listen("fleet", () => this.render());
    setInterval(() => this.render(), 1000);
    this.render();
  }

  setView(view) {
    for (const tab of this.tabs) tab.setAttribute("aria-pressed", String(tab.dataset.view === view));
  }

  #renderCounts() {
    fill(this.count, h("b", { class: "number", text: String(state.unreviewed) }), " to review", h("span", { class: "muted", text: ` of ${state.total}` }));
    document.title = `(${state.unreviewed}) ${state.info.platform_id} · sonarpost console`;
  }

  render() {
    const [text, stale] = linkText(state.fleet?.vehicles ?? []);
    this.link.textContent = text;
    this.link.classList.toggle("stale", stale || !state.online);
    this.live.textContent = state.online ? "live" : "not live";
    this.live.className = `pill ${state.online ? "good" : "bad"}`;
    document.body.dataset.online = String(state.online);
    const silent_s = (performance.now() - state.last_event_ms) / 1000;
    const banners = [];
    if (state.info.training) banners.push(h("p", { id: "training", text: "TRAINING — all contacts are simulated. Nothing is sent to a vehicle or a shore site." }));
    if (!state.online) banners.push(h("p", { class: "bad", id: "offline", text: `No connection to the console's server for ${duration(silent_s)}: the displayed data is old. Reconnecting …` }));
    const same = banners.map((one) => one.id).join() === [...this.banners.children].map((one) => one.id).join();
    if (same) banners.forEach((one, i) => { if (this.banners.children[i].textContent !== one.textContent) this.banners.children[i].textContent = one.textContent; });
    else fill(this.banners, banners);
  }
}
