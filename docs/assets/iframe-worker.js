/* Browsers refuse web workers for pages opened from a folder (file://). The search of the site runs in a worker, so such pages get
   a replacement that runs the worker's script in a hidden frame. Pages from a web server are not affected. */
if (location.protocol === "file:") {
  window.IFrameWorker = class extends EventTarget {
    constructor(url) {
      super()
      this.onmessage = null
      this.onerror = null
      const frame = document.createElement("iframe")
      frame.hidden = true
      document.body.appendChild(frame)
      this.worker = frame.contentWindow
      window.addEventListener("message", event => {
        if (event.source !== this.worker) return
        this.dispatchEvent(new MessageEvent("message", { data: event.data }))
        if (this.onmessage) this.onmessage(event)
      })
      const inFrame = `
        self.postMessage = message => parent.postMessage(message, "*")
        self.importScripts = (...urls) => urls.reduce((before, url) => before.then(() => new Promise((resolve, reject) => {
          const script = document.createElement("script")
          script.onload = resolve
          script.onerror = reject
          script.src = url
          document.body.appendChild(script)
        })), Promise.resolve())`
      frame.contentDocument.open()
      frame.contentDocument.write(`<body><script>${inFrame}<\/script><script src="${url}"><\/script></body>`)
      frame.contentDocument.close()
      this.loaded = new Promise(resolve => { this.worker.onload = resolve })
    }

    postMessage(data) {
      this.loaded.then(() => this.worker.dispatchEvent(new MessageEvent("message", { data })))
    }

    terminate() {
      this.worker.frameElement.remove()
    }
  }
  window.Worker = window.IFrameWorker
}
