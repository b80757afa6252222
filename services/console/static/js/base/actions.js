// Actions of the operator, one after the other. An action starts after the previous one has displayed its contact.

export class ActionQueue {
  constructor() {
    this.waiting = [];
    this.running = false;
  }

  get empty() { return this.waiting.length === 0; }

  add(action) {
    this.waiting.push(action);
    if (!this.running) this.#run();
  }

  /** Remove the waiting actions. */
  clear() {
    this.waiting = [];
  }

  async #run() {
    this.running = true;
    try {
      while (this.waiting.length) await this.waiting.shift()();
    } finally {
      this.running = false;
    }
  }
}
