// Registration of the service worker, which makes the page installable and shows a page without the server.

const WAIT_MS = 3000; // after the start of the page, so that its own requests are first

/** Register the service worker, where the browser permits one: with HTTPS, or on the server's own host. */
export function registerServiceWorker() {
  if (!("serviceWorker" in navigator)) return;
  setTimeout(async () => {
    try {
      await navigator.serviceWorker.register("/service_worker.js");
    } catch (error) {
      console.info(`The browser refuses the service worker: ${error.message}`);
    }
  }, WAIT_MS);
}
