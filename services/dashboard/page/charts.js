// Charts of the last two minutes: error beside sigma, weights and ages of the senses, rates of the topics.

import { $, make, onScheme, put, style, swatch } from "./format.js";
import uPlot from "./vendor/uPlot.js";

const WINDOW_S = 120;
const STEP_S = 0.1;  // ten samples a second are drawn; more are not seen
const HEIGHT = 132;

// Times and values of some series, the newest WINDOW_S of them.
class History {
  constructor(names) {
    this.names = names;
    this.data = [[], ...names.map(() => [])];
  }

  add(time, values) {
    const [times] = this.data;
    if (times.length && time <= times[times.length - 1]) return;
    this.data[0].push(time);
    values.forEach((value, i) => this.data[i + 1].push(value ?? null));
    let old = 0;
    while (times[old] < time - WINDOW_S) old++;
    if (old > 50) for (const column of this.data) column.splice(0, old);
  }
}

class Chart {
  #plot = null;
  #outputs;

  // series: of {name, colour (a variable of the style), dash}; format: a value in words; top: where the axis ends, null for as the data.
  constructor(title, series, { format, top = null, logarithmic = false }) {
    this.title = title;
    this.series = series;
    this.format = format;
    this.top = top;
    this.logarithmic = logarithmic;
    this.history = new History(series.map(({ name }) => name));
    this.#outputs = series.map(() => make("output", { textContent: "–" }));
    this.legend = make("figcaption", {}, make("b", { textContent: title }));
    this.figure = make("figure", { className: "plot" }, this.legend);
    $("plots").append(this.figure);
    this.#build();
    onScheme(() => this.#build());
    new ResizeObserver(() => this.#resize()).observe(this.figure);
  }

  add(time, values) {
    this.history.add(time, values);
    values.forEach((value, i) => put(this.#outputs[i], value === null || value === undefined ? "–" : this.format(value)));
  }

  draw(now) {
    this.#plot.setData(this.history.data, false);
    this.#plot.setScale("x", { min: now - WINDOW_S, max: now });
  }

  #width() {
    return Math.max(120, this.figure.clientWidth - 14);
  }

  #resize() {
    if (this.#plot.width !== this.#width()) this.#plot.setSize({ width: this.#width(), height: HEIGHT });
  }

  #build() {
    this.#plot?.destroy();
    this.legend.replaceChildren(this.legend.firstChild);
    this.series.forEach(({ name, colour }, i) => this.legend.append(make("span", {}, swatch(style(colour)), `${name} `, this.#outputs[i])));
    const axis = { stroke: style("quiet"), grid: { stroke: style("line"), width: 1 }, ticks: { show: false }, font: "11px system-ui, sans-serif" };
    const since = (_, splits) => splits.map((value) => `${Math.round(value - splits.at(-1)) || 0} s`);
    this.#plot = new uPlot(
      {
        width: this.#width(),
        height: HEIGHT,
        legend: { show: false },
        cursor: { show: false },
        select: { show: false },
        padding: [6, 14, 0, 0],
        scales: {
          x: { time: false, auto: false },
          y: { range: (_, low, high) => [0, this.top ?? Math.max(1e-6, 1.15 * (high ?? 1))] },
        },
        axes: [
          { ...axis, size: 22, splits: ({ scales }) => [4, 3, 2, 1, 0].map((i) => scales.x.max - (i * WINDOW_S) / 4), values: since },
          { ...axis, size: 38, space: 26 },
        ],
        series: [{}, ...this.series.map(({ colour, dash }) => ({ stroke: style(colour), width: 1.5, dash, points: { show: false }, spanGaps: false }))],
      },
      this.history.data,
      this.figure,
    );
    const canvas = this.figure.querySelector("canvas");
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `chart of ${this.title}; the numbers above it are the newest`);
  }
}

export class Charts {
  #due = 0;
  #charts = null;
  #target = "";

  constructor(link) {
    link.addEventListener("slow", ({ detail }) => this.#showRates(detail.rates));
  }

  describe(scene) {
    this.senses = scene.senses;
    const perSense = scene.senses.map((name) => ({ name, colour: name }));
    const sigma = { name: "1 σ", colour: "sigma", dash: [4, 3] };
    this.isSimulated = scene.is_simulated;
    const accuracy = scene.is_simulated ? [{ name: "error", colour: "fused" }, sigma] : [sigma];
    const times = (value) => `${value.toFixed(0)} ms`;
    this.#charts = {
      accuracy: new Chart(scene.is_simulated ? "Error [cm]" : "Sigma [cm]", accuracy, { format: (value) => value.toFixed(2) }),
      weights: new Chart("Weights [%]", perSense, { format: (value) => value.toFixed(0), top: 100 }),
      ages: new Chart("Age [ms]", perSense, { format: times }),
      rates: new Chart("Rates [Hz]", [{ name: "frame", colour: "sigma" }, { name: "vision", colour: "vision" }, { name: "haptic", colour: "haptic" }, { name: "fused", colour: "fused" }], { format: (value) => value.toFixed(0) }),
    };
  }

  show(moment, target) {
    if (!this.#charts || moment.now < this.#due) return;
    this.#due = moment.now + STEP_S - 0.01;
    if (target !== this.#target) {
      this.#target = target;
      for (const name of ["accuracy", "weights", "ages"]) this.#charts[name].history.data.forEach((column) => (column.length = 0));
    }
    const now = moment.targets[target];
    const sources = this.senses.map((name) => now.sources?.[name]);
    const spread = now.spread === undefined ? null : 100 * now.spread;
    const error = now.error ? 100 * now.error.position : null;
    this.#charts.accuracy.add(moment.now, this.isSimulated ? [error, spread] : [spread]);
    this.#charts.weights.add(moment.now, sources.map((source) => source && 100 * source.weight));
    this.#charts.ages.add(moment.now, sources.map((source) => source && Math.min(2000, 1000 * source.age)));
    for (const chart of Object.values(this.#charts)) chart.draw(moment.now);
  }

  #showRates(rates) {
    if (!this.#charts || !rates) return;
    const by = Object.fromEntries(rates.map(({ topic, rate }) => [topic, rate]));
    this.#charts.rates.add(Date.now() / 1000, ["frame", "vision", "haptic", "fused"].map((name) => by[name]));
  }
}
