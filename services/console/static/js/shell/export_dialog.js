// Exports of the queue's contacts, with progress and cancel, and the printable reports.

import { api } from "../base/api.js";
import { h, showDialog } from "../base/dom.js";
import { t } from "../texts.js";

const FORMATS = ["geojson", "kmz", "csv", "cot.xml"];
const POLL_MS = 300;

/**
 * Show the dialog.
 *
 * @param filter Filter of the queue.
 * @param matching Number of contacts of the filter.
 * @param contact Displayed contact; null for none.
 */
export async function openExportDialog(filter, matching, contact) {
  const dialog = new ExportDialog(filter);
  const reports = [h("a", { href: api.sheetsUrl(filter), target: "_blank", rel: "noopener", text: t("export_dialog.sheets", { count: matching }) })];
  if (contact) reports.unshift(h("a", { href: api.reportUrl(contact.id), target: "_blank", rel: "noopener", text: t("export_dialog.report", { name: contact.name }) }));
  const body = [h("p", { text: t("export_dialog.contacts", { count: matching }) }), h("div", { class: "exports" }, dialog.buttons, reports), dialog.element];
  await showDialog(t("export_dialog.title"), body, [{ label: t("export_dialog.close"), value: null, primary: true }]);
}

class ExportDialog {
  constructor(filter) {
    this.filter = filter;
    this.buttons = FORMATS.map((format) => h("button", { type: "button", text: t(`export_dialog.${format}`), data: { export: format }, on: { click: () => this.#save(format) } }));
    this.bar = h("progress", { max: 1, "aria-label": t("export_dialog.progress") });
    this.cancel = h("button", { type: "button", class: "cancel", text: t("export_dialog.cancel"), on: { click: () => this.#cancel() } });
    this.status = h("p", { class: "progress", role: "status" });
    this.working = h("div", { class: "working hidden" }, this.bar, this.cancel);
    this.element = h("div", {}, this.working, this.status);
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
      const url = URL.createObjectURL(await api.export(format, this.filter));
      h("a", { href: url, download: `contacts.${format}` }).click();
      setTimeout(() => URL.revokeObjectURL(url), 60000);
      this.status.textContent = t("export_dialog.saved", { name: `contacts.${format}` });
    } catch (error) {
      this.status.textContent = error.code === "cancelled" ? t("export_dialog.cancelled") : t("export_dialog.failed", { reason: error.message });
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
    const size = (progress.size_bytes / 1e6).toFixed(1);
    this.status.textContent = t(`export_dialog.${progress.state}`, { done: progress.done, total: progress.total, size });
  }

  async #cancel() {
    this.cancel.disabled = true;
    await api.cancelExport().catch((error) => { this.status.textContent = error.message; this.cancel.disabled = false; });
  }
}
