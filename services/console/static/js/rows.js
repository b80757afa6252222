// The rows of the review queue as far as they are loaded: pages of 100, at most eight of them, whatever the queue's length.

import { api } from "./api.js";

export const PAGE = 100;
const MOST_PAGES = 8;

export class Rows {
  constructor() {
    this.query = {};
    this.matching = 0;
    this.vehicles = [];
    this.pages = new Map(); // page number → rows, least recently used first
    this.generation = 0;
  }

  /** The row at an index, or undefined where it is not loaded. */
  at(index) {
    return this.pages.get(Math.floor(index / PAGE))?.[index % PAGE];
  }

  /** The index of a contact, -1 where it is not loaded. */
  indexOf(id) {
    for (const [number, rows] of this.pages) {
      const within = rows.findIndex((row) => row.id === id);
      if (within >= 0) return number * PAGE + within;
    }
    return -1;
  }

  /** Take a newer row in place; says whether the contact was loaded. */
  merge(row) {
    const index = this.indexOf(row.id);
    if (index < 0) return false;
    this.pages.get(Math.floor(index / PAGE))[index % PAGE] = row;
    return true;
  }

  async #load(number) {
    const generation = this.generation;
    const answer = await api.contacts({ ...this.query, offset: number * PAGE, limit: PAGE });
    if (generation !== this.generation) return null;
    return answer;
  }

  #keep(number, rows) {
    this.pages.delete(number);
    this.pages.set(number, rows);
    while (this.pages.size > MOST_PAGES) this.pages.delete(this.pages.keys().next().value);
  }

  /** Load what is missing of the rows first…last; returns the last answer, null where all were there. */
  async need(first, last) {
    let answer = null;
    for (let number = Math.floor(first / PAGE); number <= Math.floor(last / PAGE); number += 1) {
      if (this.pages.has(number)) {
        this.#keep(number, this.pages.get(number));
        continue;
      }
      const one = await this.#load(number);
      if (one === null) return null;
      this.#keep(number, one.items);
      this.#count(one);
      answer = one;
    }
    return answer;
  }

  /** Load the pages of the rows first…last anew and forget all others, for they may have moved. */
  async refresh(first, last) {
    this.generation += 1;
    const fresh = new Map();
    let answer = null;
    for (let number = Math.floor(first / PAGE); number <= Math.floor(last / PAGE); number += 1) {
      answer = await this.#load(number);
      if (answer === null) return null;
      fresh.set(number, answer.items);
      if (number * PAGE >= answer.matching) break;
    }
    this.pages = fresh;
    this.#count(answer);
    return answer;
  }

  #count(answer) {
    this.matching = answer.matching;
    this.vehicles = answer.vehicles;
  }
}
