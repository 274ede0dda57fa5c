// The pose in numbers, what each sense says, and the state in words for those who do not see it.

import { $, Rows, age, centimetres, degrees, make, percent, put, showState } from "./format.js";

const AXES = ["x", "y", "z", "roll", "pitch", "yaw"];
const EVERY_MS = 100;  // nobody reads numbers that change faster

export class PoseView {
  #target = "";
  #due = 0;
  #state = "";
  #rows = AXES.map((name) => {
    const cells = [make("td"), make("td"), make("td")];
    $("pose-rows").append(make("tr", {}, make("th", { scope: "row", textContent: name }), ...cells));
    return cells;
  });
  #senses = new Rows($("sense-rows"), ({ name }) => {
    const weight = make("td"), old = make("td"), says = make("td"), state = make("span", { className: "state" }), more = make("span", { className: "quiet" });
    says.append(state, " ", more);
    const element = make("tr", {}, make("th", { scope: "row", textContent: name }), weight, old, says);
    return {
      element,
      update(item) {
        put(weight, item.weight === undefined ? "" : percent(item.weight));
        put(old, item.age === undefined ? "–" : age(item.age));
        showState(state, item.state);
        put(more, item.more);
      },
    };
  });

  describe(scene) {
    put($("cell-name"), scene.cell);
    put($("pose-frame"), `in frame ${scene.frame}`);
    document.title = `${scene.cell} · Penumbra`;
    this.#target = scene.targets[0];
    $("target").replaceChildren(...scene.targets.map((name) => make("option", { value: name, textContent: name })));
    $("target-choice").hidden = scene.targets.length < 2;
    $("target").addEventListener("change", ({ target }) => (this.#target = target.value));
  }

  get target() {
    return this.#target;
  }

  show(moment, why) {
    const now = moment.targets[this.#target];
    if (now.state !== this.#state) {
      this.#state = now.state;
      const text = now.state === "none" ? "no pose" : now.state;
      showState($("pose-state"), now.state, text);
      put($("announce"), `${this.#target}: ${text}`);
      this.#due = 0;
    }
    if (performance.now() < this.#due) return;
    this.#due = performance.now() + EVERY_MS;
    put($("pose-why"), now.state === "tracking" ? "" : why);
    if (now.state === "none") {
      for (const id of ["error-now", "sigma-now", "hidden-now"]) put($(id), "–");
      for (const row of this.#rows) for (const cell of row) put(cell, "–");
      this.#senses.show([], ({ name }) => name);
      return;
    }
    put($("error-now"), now.error ? centimetres(now.error.position, 2) : "–");
    $("error-name").parentElement.hidden = !now.error;
    put($("sigma-now"), centimetres(now.spread, 2));
    const hidden = Object.values(now.senses).map((sense) => sense.hidden).filter((share) => share !== undefined);
    const truth = now.truth ? now.truth.hidden : undefined;
    put($("hidden-now"), hidden.length ? percent(Math.min(...hidden)) : truth === undefined ? "–" : percent(truth));
    $("hidden-now").title = truth === undefined ? "by vision" : `by vision; in truth ${percent(truth)}`;
    const values = [...now.pose.slice(0, 3), ...now.rpy];
    this.#rows.forEach(([value, sigma, speed], i) => {
      const format = i < 3 ? centimetres : degrees;
      put(value, format(values[i]));
      put(sigma, `± ${format(now.sigma[i])}`);
      put(speed, format(now.velocity[i], i < 3 ? 1 : 0));
    });
    this.#showSenses(now);
  }

  #showSenses(now) {
    const items = Object.entries(now.senses).map(([name, sense]) => ({ ...sense, name, weight: now.sources[sense.sense]?.weight }));
    for (const [name, { age, weight }] of Object.entries(now.sources)) {
      if (!items.some(({ sense }) => sense === name)) items.push({ name, sense: name, age, weight, state: "silent" });
    }
    for (const item of items) {
      if (item.contact) item.more = item.contact;
      else if (item.hidden !== undefined) item.more = `${percent(item.hidden)} hidden`;
      else item.more = item.gap === undefined || item.gap === null ? "" : `gap ${centimetres(item.gap)}`;
    }
    this.#senses.show(items, ({ name }) => name);
  }
}
