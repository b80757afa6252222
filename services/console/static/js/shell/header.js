// The header: views, number of unreviewed contacts, chain of places; and the banners below it.

import { alertButton, alertCount } from "./alerts.js";
import { api } from "../base/api.js";
import { Chain, chainBanner } from "./chain.js";
import { fill, h } from "../base/dom.js";
import { opener } from "../base/layout.js";
import { openScoreDialog } from "./score_dialog.js";
import { emit, listen, setting, state } from "../base/state.js";
import { t } from "../texts.js";

const VIEWS = [["review", "q"], ["map", "p"], ["fleet", "f"], ["mission", "M"]];

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

/** Buttons for password change and log-out. */
export function accountButtons() {
  const onPasswordPage = location.pathname === "/password";
  const { user, role } = state.session;
  const label = t(onPasswordPage ? "header.password" : "header.password_in_tab", { user });
  return [
    // The page opens in another tab, so that an unsent remark is kept.
    h("a", {
      class: "button", id: "to-password", href: "/password", target: onPasswordPage ? null : "_blank", rel: onPasswordPage ? null : "noopener",
      title: label, "aria-label": label, "aria-current": onPasswordPage ? "page" : null,
    }, h("span", { class: "key" })),
    h("button", { type: "button", title: t("header.log_out_title", { user, role }), on: { click: logout } }, t("header.log_out", { user })),
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
    this.chain = new Chain();
    this.tabs = VIEWS.map(([name, key]) => h("button", {
      type: "button", "aria-pressed": "false", data: { view: name }, on: { click: () => emit("view", { name }) },
    }, `${t(`header.view.${name}`)} `, h("kbd", { text: key })));
    const button = (name, text, handler) => h("button", { type: "button", title: t(name), "aria-label": t(name), on: { click: handler } }, text);
    const menu = h("div", { class: "menu-items" },
      h("nav", { "aria-label": t("header.views") }, this.tabs),
      state.info.known_objects ? h("button", { type: "button", id: "score", text: t("score.title"), on: { click: openScoreDialog } }) : null,
      button("header.exports", "⇩", actions.exports),
      button("header.theme", "◐", toggleTheme),
      button("header.type_size", "A±", toggleTypeSize),
      h("button", { type: "button", id: "settings", title: `${t("settings.title")} (;)`, "aria-label": `${t("settings.title")} (;)`, on: { click: actions.settings } }, "⚙"),
      button("header.keys", "?", actions.help),
      accountButtons());
    const menuButton = h("button", { type: "button", class: "menu-button", "aria-label": t("layout.menu"), title: t("layout.menu"), text: "☰" });
    const { close } = opener(menuButton, menu);
    menu.addEventListener("click", (event) => { if (event.target.closest("button, a")) close(); });
    fill(this.element,
      h("h1", {}, h("img", { src: "/static/icon.svg", alt: "", width: 26, height: 26 }), state.info.platform_id),
      this.count, h("span", { class: "gap" }), this.chain.element, alertButton(), menuButton, menu);
    for (const name of ["counts", "alerts"]) listen(name, () => this.#renderCounts());
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
    fill(this.count, h("b", { class: "number", text: String(state.unreviewed) }), ` ${t("header.to_review")}`, h("span", { class: "muted", text: ` ${t("header.of", { total: state.total })}` }));
    const title = t("header.title", { unreviewed: state.unreviewed, platform: state.info.platform_id });
    document.title = alertCount() ? t("header.title_alerts", { count: alertCount(), title }) : title;
  }

  render() {
    this.chain.render();
    document.body.dataset.online = String(state.online);
    const banners = [state.info.training ? h("p", { id: "training" }, h("b", { text: t("header.training") }), " ", h("span", { text: t("header.training_note") })) : null, chainBanner()].filter(Boolean);
    const shown = [...this.banners.children];
    const same = banners.map((one) => one.id).join() === shown.map((one) => one.id).join();
    // An unchanged banner keeps its element: a screen reader reads each one once.
    if (!same) fill(this.banners, banners);
    else banners.forEach((one, i) => { if (shown[i].textContent !== one.textContent) shown[i].replaceWith(one); });
  }
}
