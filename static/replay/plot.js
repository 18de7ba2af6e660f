// The curves of one joint over the whole episode, with what happened drawn behind and over them.

const KINDS = [
  { name: "measured", colour: "--curve-1", width: 2 },
  { name: "executed", colour: "--curve-2", width: 1.5 },
  { name: "smoothed", colour: "--curve-3", width: 1.5, dash: [4, 4] },
];
const SAFETY_HEIGHT = 5; // px

export const LEGEND = [...KINDS, { name: "raw", colour: "--edge" }];

function css(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

/** NaN is no value to uPlot. */
function blank(values) {
  return Array.from(values, (value) => (Number.isNaN(value) ? null : value));
}

export class Plot {
  #element;
  #library;
  #plot = null;
  #cursor = document.createElement("i");
  #data;
  #behind; // {held, marks, safety, chunks}
  #time = 0;

  constructor({ element, library, behind, seek }) {
    this.#element = element;
    this.#library = library;
    this.#behind = behind;
    this.seek = seek;
    this.#cursor.className = "replay-cursor";
    new ResizeObserver(() => this.#fit()).observe(element);
    document.addEventListener("eva:theme", () => this.#build());
  }

  /** `curves`: {time, measured, executed, smoothed} of one joint; `chunks`: [{times, values}] as the policy gave them. */
  show(curves, chunks) {
    this.#behind.chunks = chunks;
    this.#data = [Array.from(curves.time), ...KINDS.map((kind) => blank(curves[kind.name]))];
    if (this.#plot) this.#plot.setData(this.#data);
    else this.#build();
    this.at(this.#time);
  }

  /** Move the line of the clock. */
  at(time) {
    this.#time = time;
    if (!this.#plot) return;
    const left = this.#plot.valToPos(time, "x");
    this.#cursor.hidden = left < 0 || left > this.#plot.over.clientWidth;
    this.#cursor.style.transform = `translateX(${left}px)`;
  }

  #fit() {
    const { clientWidth: width, clientHeight: height } = this.#element;
    if (this.#plot && width && height) this.#plot.setSize({ width, height });
    this.at(this.#time);
  }

  #build() {
    if (!this.#data) return;
    this.#plot?.destroy();
    const line = { stroke: css("--text-muted"), grid: { stroke: css("--hairline"), width: 1 }, ticks: { show: false }, font: `13px ${css("--font")}` };
    const options = {
      width: this.#element.clientWidth || 600,
      height: this.#element.clientHeight || 160,
      legend: { show: false },
      cursor: { drag: { x: true, y: false }, points: { show: false } },
      scales: { x: { time: false }, y: { range: (plot, low, high) => spread(low, high) } },
      axes: [
        { ...line, size: 24, values: (plot, ticks) => ticks.map((tick) => `${tick} s`) },
        { ...line, size: 56, values: (plot, ticks) => ticks.map((tick) => tick.toFixed(2)) },
      ],
      series: [{}, ...KINDS.map((kind) => ({ label: kind.name, stroke: css(kind.colour), width: kind.width, dash: kind.dash, points: { show: false } }))],
      hooks: {
        drawAxes: [(plot) => this.#drawBehind(plot)],
        draw: [(plot) => this.#drawOver(plot)],
        setScale: [() => this.at(this.#time)],
      },
    };
    this.#plot = new this.#library(options, this.#data, this.#element);
    this.#plot.over.append(this.#cursor);
    this.#pick(this.#plot);
    this.at(this.#time);
  }

  /** A click goes there; a drag looks closer, a double click at everything. */
  #pick(plot) {
    let pressed = null;
    plot.over.addEventListener("pointerdown", (event) => (pressed = event.clientX));
    plot.over.addEventListener("pointerup", (event) => {
      const moved = pressed === null || Math.abs(event.clientX - pressed) > 4;
      pressed = null;
      if (!moved) this.seek(plot.posToVal(event.clientX - plot.over.getBoundingClientRect().left, "x"));
    });
  }

  #inside(plot, draw) {
    const { left, top, width, height } = plot.bbox;
    plot.ctx.save();
    plot.ctx.beginPath();
    plot.ctx.rect(left, top, width, height);
    plot.ctx.clip();
    draw(plot.ctx, (time) => plot.valToPos(time, "x", true), { top, height });
    plot.ctx.restore();
  }

  #drawBehind(plot) {
    this.#inside(plot, (ctx, x, { top, height }) => {
      ctx.fillStyle = css("--holding-soft");
      for (const [from, to] of this.#behind.held) ctx.fillRect(x(from), top, Math.max(1, x(to) - x(from)), height);
      ctx.fillStyle = css("--edge");
      for (const { time } of this.#behind.marks) ctx.fillRect(Math.round(x(time)), top, 1, height);
      ctx.strokeStyle = css("--edge");
      ctx.globalAlpha = 0.7;
      ctx.lineWidth = devicePixelRatio;
      ctx.beginPath();
      for (const { times, values } of this.#behind.chunks) {
        values.forEach((value, index) => {
          const at = [x(times[index]), plot.valToPos(value, "y", true)];
          if (index) ctx.lineTo(...at);
          else ctx.moveTo(...at);
        });
      }
      ctx.stroke();
    });
  }

  #drawOver(plot) {
    this.#inside(plot, (ctx, x, { top, height }) => {
      const tall = SAFETY_HEIGHT * devicePixelRatio;
      for (const { time, refused } of this.#behind.safety) {
        ctx.fillStyle = css(refused ? "--faulted" : "--holding");
        ctx.fillRect(x(time), top + height - tall * (refused ? 2 : 1), Math.max(1, devicePixelRatio), tall * (refused ? 2 : 1));
      }
    });
  }
}

/** The range of the value axis: never so narrow that noise looks like motion. */
function spread(low, high) {
  if (low === null || !Number.isFinite(low)) return [-0.1, 0.1];
  const middle = (low + high) / 2;
  const half = Math.max((high - low) * 0.58, 0.02);
  return [middle - half, middle + half];
}
