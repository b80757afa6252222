// Service worker: without the server, the page "no connection" from a cache of the static files. Data and images of the
// server are never stored. The server adds VERSION, a hash of the static files, and FILES, their addresses.

const CACHE = `sonarpost-${VERSION}`;
const OFFLINE = "/static/offline.html";

self.addEventListener("install", (event) => event.waitUntil((async () => {
  const cache = await caches.open(CACHE);
  await cache.addAll(FILES.map((address) => new Request(address, { cache: "no-cache" })));
  await self.skipWaiting();
})()));

self.addEventListener("activate", (event) => event.waitUntil((async () => {
  const others = (await caches.keys()).filter((name) => name !== CACHE);
  await Promise.all(others.map((name) => caches.delete(name)));
  await self.clients.claim();
})()));

/** The response of the server; without one, that of the cache. */
async function respond(request, cached) {
  try {
    return await fetch(request);
  } catch (error) {
    const found = await caches.match(cached, { cacheName: CACHE });
    if (!found) throw error;
    return found;
  }
}

self.addEventListener("fetch", (event) => {
  const { request } = event;
  const { origin, pathname } = new URL(request.url);
  if (request.method !== "GET" || origin !== self.location.origin) return;
  if (request.mode === "navigate") event.respondWith(respond(request, OFFLINE));
  else if (FILES.includes(pathname)) event.respondWith(respond(request, pathname));
});
