// The places between the operator and the vehicles, each with its state and age; a banner names the first fault.

import { age, since } from "../base/ages.js";
import { fill, h } from "../base/dom.js";
import { duration } from "../base/format.js";
import { now, state } from "../base/state.js";
import { t } from "../texts.js";

const SYMBOLS = { ok: "●", waiting: "◌", degraded: "▲", lost: "✕", unknown: "○" };
const TONES = { ok: "good", waiting: "muted", degraded: "stale", lost: "bad", unknown: "muted" };

const silent_s = () => (performance.now() - state.last_event_ms) / 1000;

/** All places, from this page outwards. Without events, the last known states behind the server are old. */
export function chainLinks() {
  const links = (state.fleet?.chain ?? []).map((link) => (state.online ? link : { ...link, state: "unknown" }));
  const heard_utc_s = now() - silent_s();
  const page = { place: "browser", name: "", state: state.refused ? "degraded" : "ok", reason: state.refused ? "refused" : "", detail: state.refused, since_utc_s: heard_utc_s, heard_utc_s };
  const server = links.find((link) => link.place === "server") ?? { place: "server", name: "console", detail: "" };
  const others = links.filter((link) => link.place !== "server");
  if (state.online) return [page, { state: "ok", ...server, heard_utc_s }, ...others];
  const stopped = state.refused ? { state: "unknown" } : { state: "lost", reason: "no_connection" };
  return [page, { ...server, ...stopped, since_utc_s: heard_utc_s, heard_utc_s }, ...others];
}

const placeName = (link) => (link.place === "vehicle" && link.name ? link.name : t(`chain.place.${link.place}`));

/** The place with the worst fault nearest to the operator; undefined if there is none. */
const worst = (links) => links.find((link) => link.state === "lost") ?? links.find((link) => link.state === "degraded");

/** What is wrong at a place. */
function fault(link) {
  const text = t(`chain.fault.${link.reason}`, { place: placeName(link), name: link.name });
  return link.detail ? t("chain.with_detail", { text, detail: link.detail }) : text;
}

function bannerText(link) {
  const values = { since: since(link.since_utc_s ?? now()), fault: fault(link), duration: duration(now() - (link.since_utc_s ?? now())) };
  if (link.reason === "no_connection") return t("chain.banner.offline", values);
  if (link.reason === "refused") return t("chain.banner.refused", { reason: link.detail });
  return t(link.state === "lost" ? "chain.banner.lost" : "chain.banner.degraded", values);
}

/** Banner of the worst fault: an element, or null. */
export function chainBanner() {
  const link = worst(chainLinks());
  if (!link) return null;
  const id = link.place === "browser" || link.place === "server" && link.state === "lost" ? "offline" : "fault";
  return h("p", { class: link.state === "lost" ? "bad" : "", id, data: { place: link.place }, text: bannerText(link) });
}

/** The chain in the header: a symbol and a name for each place, and details on request. */
export class Chain {
  constructor() {
    this.summary = h("summary", { class: "number" });
    this.list = h("ul", { class: "places" });
    this.element = h("details", { id: "chain", class: "chain", on: { keydown: (event) => this.#key(event), toggle: () => this.render() } }, this.summary, this.list);
  }

  #key(event) {
    if (event.key !== "Escape" || !this.element.open) return;
    event.stopPropagation();
    this.element.open = false;
    this.summary.focus();
  }

  render() {
    const links = chainLinks();
    const fault = worst(links);
    this.element.dataset.worst = fault?.state ?? "ok";
    document.getElementById("bar").dataset.worst = fault?.state ?? "ok";
    const label = t("chain.label", { places: links.map((link) => `${placeName(link)} ${t(`chain.state.${link.state}`)}`).join(", ") });
    this.summary.setAttribute("aria-label", label);
    // The decoder is in the details unless it has a fault: the header has little space.
    const shown = links.filter((link) => link.place !== "decoder" || ["lost", "degraded"].includes(link.state));
    // A narrow header has space for one place: the fault, or the last one.
    const key = fault ?? shown.at(-1);
    fill(this.summary, shown.map((link) => h("span", { class: `place ${TONES[link.state]}${link === key ? " key-place" : ""}`, data: { place: link.place, state: link.state } },
      h("span", { "aria-hidden": "true", text: SYMBOLS[link.state] }),
      h("span", { class: "name", text: ` ${placeName(link)}` }),
      link.place === "vehicle" && link.heard_utc_s ? h("span", { class: "age", text: ` ${duration(now() - link.heard_utc_s)}` }) : null)));
    if (this.element.open) this.#renderList(links);
    else this.list.replaceChildren();
  }

  #renderList(links) {
    fill(this.list, links.map((link) => h("li", {},
      h("b", {}, h("span", { class: TONES[link.state], "aria-hidden": "true", text: SYMBOLS[link.state] }), ` ${placeName(link)}`),
      h("span", { class: TONES[link.state], text: t(`chain.state.${link.state}`) }),
      h("span", { class: "number", text: link.heard_utc_s ? t("chain.heard", { age: age(link.heard_utc_s) }) : link.since_utc_s ? t("chain.since", { since: since(link.since_utc_s) }) : "" }),
      h("span", { class: "detail", text: link.reason ? fault(link) : link.detail }))));
  }
}
