// What happened: states of the pose with their reasons, processes that came and went. A band shows the last two minutes of states.

import { $, Rows, clock, make, onScheme, put, showState, style } from "./format.js";

const WINDOW_S = 120;
const SHOWN = 80;
const COLOURS = { tracking: "good", coasting: "middling", lost: "bad", none: "line" };

export class TimelineView {
  #entries = [];
  #due = 0;
  #rows = new Rows($("events"), (entry) => {
    const state = make("span", { className: "state" }), why = make("span", { className: "why" });
    const element = make("li", {}, make("time", { textContent: clock(entry.time) }), make("span", { textContent: entry.about }), make("span", {}, state), why);
    return {
      element,
      update(now) {
        showState(state, now.state, now.state === "none" ? "no pose" : now.state);
        put(why, now.why);
      },
    };
  });

  constructor(link) {
    link.addEventListener("slow", ({ detail }) => {
      this.#entries = detail.timeline;
      this.#list();
    });
    $("only-poses").addEventListener("change", () => this.#list());
    onScheme(() => (this.#due = 0));
  }

  // Why the target is in its present state, in words; empty where that is not known.
  why(target) {
    return this.#of(target).at(-1)?.why ?? "";
  }

  show(moment, target) {
    if (moment.now < this.#due) return;
    this.#due = moment.now + 0.25;
    const canvas = $("band"), width = Math.round(canvas.clientWidth * devicePixelRatio);
    if (canvas.width !== width) canvas.width = width;
    const context = canvas.getContext("2d");
    context.clearRect(0, 0, width, canvas.height);
    const x = (time) => Math.max(0, ((time - moment.now) / WINDOW_S + 1) * width);
    const own = this.#of(target);
    own.forEach(({ time, state }, i) => {
      const until = own[i + 1]?.time ?? moment.now;
      if (until < moment.now - WINDOW_S) return;
      context.fillStyle = style(COLOURS[state] ?? "line");
      context.fillRect(x(time), 0, Math.max(1, x(until) - x(time)), canvas.height);
    });
  }

  #of(target) {
    return this.#entries.filter(({ about, kind }) => kind === "target" && about === target);
  }

  #list() {
    const only = $("only-poses").checked;
    const shown = this.#entries.filter(({ kind }) => !only || kind === "target").slice(-SHOWN).reverse();
    this.#rows.show(shown, ({ number }) => number);
  }
}
