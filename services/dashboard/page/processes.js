// Processes with their health and a button to restart each, and the traffic by topic.

import { $, Rows, make, put, showState } from "./format.js";

export class ProcessesView {
  #maySteer = false;
  #canRestart = false;
  #pending = new Set();
  #rows = new Rows($("process-rows"), (item) => this.#build(item));
  #topics = new Rows($("topic-rows"), ({ topic, about }) => {
    const cells = ["rate", "nominal", "delay", "dropped", "refused"].map(() => make("td", { className: "number" }));
    const element = make("tr", {}, make("th", { scope: "row", textContent: topic }), ...cells, make("td", { className: "about", textContent: about }));
    return {
      element,
      update(item) {
        const values = [item.rate?.toFixed(1), item.nominal, item.delay === null ? null : (1000 * item.delay).toFixed(1), item.dropped, item.refused];
        cells.forEach((cell, i) => put(cell, `${values[i] ?? "–"}`));
      },
    };
  });

  constructor(link) {
    this.link = link;
    link.addEventListener("hello", ({ detail }) => (this.#maySteer = detail.may_steer));
    link.addEventListener("slow", ({ detail }) => this.#show(detail));
  }

  #show({ processes, rates }) {
    if (!processes) return;
    this.#canRestart = processes.can_restart;
    this.#rows.show(processes.rows, ({ id }) => id);
    this.#topics.show(rates, ({ topic }) => topic);
  }

  #build({ name, service, about }) {
    const status = make("span", { className: "state" }), why = make("td", { className: "why" });
    const numbers = ["cpu", "memory", "restarts"].map(() => make("td", { className: "number" }));
    const button = make("button", { type: "button", textContent: "Restart" });
    button.setAttribute("aria-label", `Restart ${name}`);
    button.addEventListener("click", () => this.#restart(service));
    const head = make("th", { scope: "row", textContent: name, title: about });
    const element = make("tr", {}, head, make("td", {}, status), why, ...numbers, make("td", {}, button));
    return {
      element,
      update: (item) => {
        put(head, item.name);
        showState(status, item.status);
        put(why, item.why);
        put(numbers[0], item.cpu === null ? "–" : `${Math.round(100 * item.cpu)} %`);
        put(numbers[1], item.memory === null ? "–" : item.memory.toFixed(0));
        put(numbers[2], `${item.restarts}`);
        const can = this.#maySteer && this.#canRestart && item.can_restart && !this.#pending.has(item.service);
        if (button.disabled === can) button.disabled = !can;
        button.title = can ? `Restart ${item.service}` : this.#why(item);
      },
    };
  }

  #why(item) {
    if (!this.#maySteer) return "this page may only look";
    if (!this.#canRestart) return "no launcher runs: what started the processes restarts them";
    if (this.#pending.has(item.service)) return "restarting";
    return "all others meet at the router; penumbra up restarts it";
  }

  async #restart(service) {
    this.#pending.add(service);
    put($("restart-said"), `restarting ${service} …`);
    try {
      const { what, error } = await this.link.ask("restart", { service });
      put($("restart-said"), error ? `${what}: ${error}` : `${what}: done`);
    } catch (error) {
      put($("restart-said"), `restart of ${service}: ${error.message}`);
    } finally {
      this.#pending.delete(service);
    }
  }
}
