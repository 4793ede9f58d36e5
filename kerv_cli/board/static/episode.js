// A film of one image per control step, and its connection to the grid of tokens.
customElements.define("film-player", class extends HTMLElement {
  connectedCallback() {
    this.image = this.querySelector("img");
    this.slider = this.querySelector("input");
    this.button = this.querySelector("button");
    this.frames = [];
    this.slider.addEventListener("input", () => { this.pause(); this.show(Number(this.slider.value)); });
    this.button.addEventListener("click", () => this.playing ? this.pause() : this.play());
  }

  disconnectedCallback() { this.pause(); }

  show(step) {
    const last = Number(this.slider.max);
    step = Math.min(step, last);
    this.slider.value = step;
    this.image.src = this.dataset.source.replace("STEP", step);
    this.querySelector("output").textContent = `step ${step}`;
    this.dispatchEvent(new CustomEvent("step", { bubbles: true, detail: step }));
  }

  play() {
    const last = Number(this.slider.max), first = Number(this.slider.value) % last, hz = Number(this.dataset.hz);
    for (let step = this.frames.length; step <= last; step++) {  // load all images once
      this.frames.push(Object.assign(new Image(), { src: this.dataset.source.replace("STEP", step) }));
    }
    const began = performance.now();
    const draw = (now) => {
      const step = first + Math.max(0, Math.floor((now - began) / 1000 * hz));
      this.show(step);
      this.playing = step < last ? requestAnimationFrame(draw) : this.pause();
    };
    this.button.textContent = "❚❚";
    this.button.setAttribute("aria-label", "pause");
    this.playing = requestAnimationFrame(draw);
  }

  pause() {
    cancelAnimationFrame(this.playing);
    this.playing = undefined;
    this.button.textContent = "▶";
    this.button.setAttribute("aria-label", "play");
  }
});

const rows = () => [...document.querySelectorAll(".tokens tbody tr")];

// the film marks the decode whose actions it shows
document.addEventListener("step", (event) => {
  const now = rows().findLast((row) => Number(row.dataset.step) <= event.detail);
  rows().forEach((row) => row.classList.toggle("now", row === now));
  reveal(now);
});

// scrolls the grid, and not the page, to a row that is out of sight
function reveal(row) {
  const box = document.querySelector(".box");
  if (row && (row.offsetTop < box.scrollTop + 80 || row.offsetTop + 40 > box.scrollTop + box.clientHeight)) {
    box.scrollTop = row.offsetTop - box.clientHeight / 2;
  }
}
reveal(document.querySelector(".tokens .chosen"));

// a row is chosen anywhere, and the film goes to its first step
document.addEventListener("click", (event) => {
  const row = event.target.closest(".tokens tbody tr");
  if (row && event.target.tagName !== "A") row.querySelector("a").click();
});
document.addEventListener("htmx:beforeRequest", (event) => {
  const row = event.target.closest(".tokens tbody tr");
  if (!row) return;
  rows().forEach((one) => one.classList.toggle("chosen", one === row));
  const film = document.querySelector("film-player");
  if (film) { film.pause(); film.show(Number(row.dataset.step)); }
});

// arrow keys go from decode to decode
document.addEventListener("keydown", (event) => {
  const row = event.target.closest(".tokens tbody tr");
  const other = row && { ArrowDown: row.nextElementSibling, ArrowUp: row.previousElementSibling }[event.key];
  if (!other) return;
  event.preventDefault();
  const link = other.querySelector("a");
  link.focus();
  link.click();
});
