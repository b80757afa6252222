// The header: views, number of contacts to do, clock, chain of places, menu; and the banners below it.

import { alertButton, alertCount } from "./alerts.js";
import { api } from "../base/api.js";
import { Chain, chainBanner } from "./chain.js";
import { fill, h, showError } from "../base/dom.js";
import { time } from "../base/format.js";
import { opener } from "../base/layout.js";
import { openPasswordDialog } from "./password_dialog.js";
import { openScoreDialog } from "./score_dialog.js";
import { emit, listen, now, setting, state } from "../base/state.js";
import { number, t } from "../texts.js";

const VIEWS = [["review", "q"], ["map", "p"], ["fleet", "f"]];

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

const logout = () => api.logout().then(() => location.assign("/login"), showError);

export class Header {
  /** @param {{exports: () => void, settings: () => void, help: () => void}} actions Items of the menu that other parts of the page handle. */
  constructor(actions) {
    this.element = document.getElementById("bar");
    this.banners = document.getElementById("banners");
    this.count = h("span", { class: "count", id: "to-do" });
    this.clock = h("time", { id: "clock", class: "number", title: t("header.clock") });
    this.unauthenticated = h("span", { id: "unauthenticated", class: "pill stale hidden", title: t("header.unauthenticated_title"), text: `⚠ ${t("header.unauthenticated")}` });
    this.undelivered = h("button", { type: "button", id: "undelivered", class: "hidden", title: t("header.undelivered_title"), on: { click: () => emit("undelivered") } });
    this.chain = new Chain();
    this.tabs = VIEWS.map(([name, key]) => h("button", {
      type: "button", "aria-pressed": "false", data: { view: name }, on: { click: () => emit("view", { name }) },
    }, `${t(`header.view.${name}`)} `, h("kbd", { text: key })));
    const { user, role } = state.session;
    const item = (name, handler, text = t(`header.menu.${name}`)) => h("button", { type: "button", data: { item: name }, text, on: { click: handler } });
    const menu = h("div", { class: "menu" },
      h("p", { class: "muted", text: t("header.user", { user, role: t(`header.role.${role}`) }) }),
      item("exports", actions.exports),
      item("score", openScoreDialog, t("score.title")),
      item("settings", actions.settings, t("settings.title")),
      item("theme", toggleTheme), item("type_size", toggleTypeSize),
      item("keys", actions.help, t("shortcuts.title")),
      item("password", openPasswordDialog), item("log_out", logout));
    const menuButton = h("button", { type: "button", id: "menu", "aria-label": user }, h("span", { class: "name", text: `${user} ` }), "▾");
    const { close } = opener(menuButton, menu);
    menu.addEventListener("click", (event) => { if (event.target.closest("button")) close(); });
    fill(this.element,
      h("h1", {}, h("img", { src: "/static/icon.svg", alt: "", width: 26, height: 26 }), state.info.platform_id),
      h("nav", { "aria-label": t("header.views") }, this.tabs), this.count, this.undelivered, h("span", { class: "gap" }),
      this.unauthenticated, this.clock, this.chain.element, alertButton(), menuButton, menu);
    for (const name of ["counts", "alerts"]) listen(name, () => this.#renderCounts());
    listen("online", () => this.render());
    listen("fleet", () => this.render());
    setInterval(() => this.render(), 1000);
    this.render();
  }

  setView(view) {
    for (const tab of this.tabs) tab.setAttribute("aria-pressed", String(tab.dataset.view === view));
  }

  #renderCounts() {
    this.unauthenticated.classList.toggle("hidden", state.counts.authenticated !== false);
    fill(this.count, h("b", { class: "number", text: number(state.counts.to_do) }), ` ${t("queue_filters.review.to_do")}`, h("span", { class: "muted", text: ` ${t("header.of", { total: state.counts.total })}` }));
    const { undelivered, refused } = state.counts;
    this.undelivered.classList.toggle("hidden", undelivered === 0);
    this.undelivered.classList.toggle("bad", refused > 0);
    this.undelivered.textContent = refused ? t("header.refused", { undelivered, refused }) : t("header.undelivered", { undelivered });
    const title = t("header.title", { to_do: state.counts.to_do, platform: state.info.platform_id });
    document.title = alertCount() ? t("header.title_alerts", { count: alertCount(), title }) : title;
  }

  render() {
    this.chain.render();
    this.clock.textContent = t("age.time", { time: time(now()) });
    document.body.dataset.online = String(state.online);
    const banners = [state.info.training ? h("p", { id: "training" }, h("b", { text: t("header.training") }), " ", h("span", { text: t("header.training_note") })) : null, chainBanner()].filter(Boolean);
    const shown = [...this.banners.children];
    const same = banners.map((one) => one.id).join() === shown.map((one) => one.id).join();
    // An unchanged banner keeps its element: a screen reader reads each one once.
    if (!same) fill(this.banners, banners);
    else banners.forEach((one, i) => { if (shown[i].textContent !== one.textContent) shown[i].replaceWith(one); });
  }
}
