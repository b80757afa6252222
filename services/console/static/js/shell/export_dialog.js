// Exports of the queue's contacts, with progress and cancel, and the printable reports.

import { api } from "../base/api.js";
import { fill, h, labelled, showDialog } from "../base/dom.js";
import { quantity, secondsOf } from "../base/format.js";
import { state } from "../base/state.js";
import { hasText, t } from "../texts.js";

const POLL_MS = 300;

/**
 * Show the dialog.
 *
 * @param {Record<string, string | number | null>} filter Filter of the queue.
 * @param {{id: string, name: string} | null} contact Displayed contact.
 */
export async function openExportDialog(filter, contact) {
  const dialog = new ExportDialog(filter, contact);
  await Promise.all([dialog.count(), showDialog(t("header.menu.exports"), dialog.element)]);
}

class ExportDialog {
  constructor(filter, contact) {
    this.filter = filter;
    const text = (format, label) => (hasText(`export_dialog.${format}`) ? t(`export_dialog.${format}`) : label);
    this.buttons = Object.entries(state.info.exports).map(([format, label]) => h("button", { type: "button", text: text(format, label), data: { export: format }, on: { click: () => this.#save(format) } }));
    const field = (name) => h("input", { type: "datetime-local", step: 1, value: timeOf(filter[name]), on: { change: () => this.count() } });
    this.from = field("from_utc_s");
    this.to = field("to_utc_s");
    this.matching = h("p", { role: "status" });
    this.sheets = h("a", { target: "_blank", rel: "noopener" });
    const report = contact && h("a", { href: api.reportUrl(contact.id), target: "_blank", rel: "noopener", text: t("export_dialog.report", { name: contact.name }) });
    this.bar = h("progress", { max: 1, "aria-label": t("export_dialog.progress") });
    this.cancel = h("button", { type: "button", class: "cancel", text: t("dialog.cancel"), on: { click: () => this.#cancel() } });
    this.status = h("p", { class: "progress", role: "status" });
    this.working = h("div", { class: "working hidden" }, this.bar, this.cancel);
    this.element = h("div", {}, h("div", { class: "times" }, labelled(t("export_dialog.from"), this.from), labelled(t("export_dialog.to"), this.to)), this.matching,
      h("div", { class: "exports" }, this.buttons, report, this.sheets), this.working, this.status);
  }

  /** The filter of the queue with the times of the dialog. */
  get query() {
    return { ...this.filter, from_utc_s: secondsOf(this.from), to_utc_s: secondsOf(this.to) };
  }

  /** Show how many contacts are exported. */
  async count() {
    const query = this.query;
    this.sheets.href = api.sheetsUrl(query);
    try {
      const { matching } = await api.contacts({ ...query, offset: 0, limit: 1 });
      if (this.sheets.getAttribute("href") !== api.sheetsUrl(query)) return; // changed since
      fill(this.matching, t("export_dialog.contacts", { count: matching }));
      fill(this.sheets, t("export_dialog.sheets", { count: matching }));
    } catch (error) {
      fill(this.matching, error.message);
    }
  }

  /** Save an export as a file. The server prepares it during the request; its progress is polled. */
  async #save(format) {
    for (const button of this.buttons) button.disabled = true;
    this.cancel.disabled = false;
    this.bar.removeAttribute("value");
    this.working.classList.remove("hidden");
    this.status.textContent = t("export_dialog.prepares");
    const timer = setInterval(() => this.#showProgress(), POLL_MS);
    try {
      const url = URL.createObjectURL(await api.export(format, this.query));
      h("a", { href: url, download: `contacts.${format}` }).click();
      setTimeout(() => URL.revokeObjectURL(url), 60000);
      this.status.textContent = t("export_dialog.saved", { name: `contacts.${format}` });
    } catch (error) {
      this.status.textContent = error.code === "cancelled" ? error.message : t("export_dialog.failed", { reason: error.message });
    } finally {
      clearInterval(timer);
      this.working.classList.add("hidden");
      for (const button of this.buttons) button.disabled = false;
    }
  }

  async #showProgress() {
    const response = await api.exportProgress().catch(() => null); // shown by the export itself
    const progress = response?.export;
    if (!progress || progress.total === null || this.working.classList.contains("hidden")) return;
    this.bar.value = progress.total ? progress.done / progress.total : 1;
    const size = quantity(progress.size_bytes / 1e6);
    this.status.textContent = t(`export_dialog.${progress.state}`, { done: progress.done, total: progress.total, size });
  }

  async #cancel() {
    this.cancel.disabled = true;
    await api.cancelExport().catch((error) => { this.status.textContent = error.message; this.cancel.disabled = false; });
  }
}

/** Text of a time in a field, which shows UTC; empty for none. */
const timeOf = (utc_s) => (utc_s || utc_s === 0 ? new Date(utc_s * 1000).toISOString().slice(0, 19) : "");
