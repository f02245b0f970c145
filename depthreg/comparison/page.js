"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const $ = (selector) => document.querySelector(selector);
const $$ = (selector) => [...document.querySelectorAll(selector)];
const shown = data.rows.map(() => true);

// The table

function chooseSet(set) {
  for (const button of $$("button.set")) button.setAttribute("aria-pressed", button.dataset.set === set);
  for (const cell of $$("#table [data-sets]")) cell.hidden = !cell.dataset.sets.split(" ").includes(set);
}

// Numbers within names count as numbers: 0.02 comes before 0.1, and 2 before 10.
const pieces = (text) => text.split(/(\d+(?:\.\d+)?(?:e[-+]?\d+)?)/i).map((piece, i) => (i % 2 ? Number(piece) : piece));
function compareNames(a, b) {
  const [left, right] = [pieces(a), pieces(b)];
  const i = left.findIndex((piece, k) => piece !== right[k]);
  return i < 0 ? left.length - right.length : left[i] < right[i] ? -1 : 1;
}

// What has no value comes last, whichever the direction.
function sortBy(heading) {
  const index = [...heading.parentElement.children].indexOf(heading);
  const ascending = heading.getAttribute("aria-sort") !== "ascending";
  for (const other of $$("#table thead [aria-sort]")) other.setAttribute("aria-sort", "none");
  heading.setAttribute("aria-sort", ascending ? "ascending" : "descending");
  const value = (row) => row.children[index].dataset.value;
  const isText = heading.classList.contains("name");
  const compare = (a, b) => {
    if (value(a) === "" || value(b) === "") return (value(a) === "") - (value(b) === "");
    const order = isText ? compareNames(value(a), value(b)) : value(a) - value(b);
    return ascending ? order : -order;
  };
  const body = $("#table tbody");
  body.append(...[...body.children].sort(compare));
}

// The curves

const plots = data.figures.map((_, i) => document.getElementById(`plot-${i}`));

function drawCurves() {
  data.figures.forEach((figure, i) =>
    Plotly.newPlot(plots[i], figure.data, figure.layout, { responsive: true, displayModeBar: false }),
  );
}

function showCurves() {
  const details = $("#details").checked;
  for (const plot of plots) {
    const visible = plot.data.map((trace) => shown[trace.meta] && (details || trace.name !== "detail"));
    Plotly.restyle(plot, { visible });
  }
}

function scaleLosses(type) {
  for (const plot of plots) Plotly.relayout(plot, { "yaxis.type": type, "yaxis2.type": type });
}

// The pictures

function showPictures() {
  if (!$("#strip")) return;
  const moment = $("#moment").value;
  $("#when").textContent = data.moments[moment];
  $("#moment").setAttribute("aria-valuetext", data.moments[moment]);
  const images = data.shown[[$("#seed").value, moment, $("#frame").value].join()] ?? {};
  const visible = $$("#table tbody tr").map((row) => Number(row.dataset.row)).filter((row) => shown[row]);
  $("#strip").replaceChildren(...visible.map((row) => figureOf(row, data.images[images[row]])));
}

function figureOf(row, image) {
  const figure = document.createElement("figure");
  const caption = document.createElement("figcaption");
  const dot = document.createElement("i");
  dot.style.setProperty("--row", data.rows[row].color);
  caption.append(dot, data.rows[row].name);
  figure.append(caption, image ? buttonOf(row, image) : nothing());
  return figure;
}

function buttonOf(row, image) {
  const button = document.createElement("button");
  const picture = document.createElement("img");
  button.type = "button";
  picture.src = image.source;
  picture.alt = `${data.rows[row].name}: ${image.file}`;
  button.title = image.file;
  button.append(picture);
  button.addEventListener("click", () => {
    $("#zoom p").textContent = picture.alt;
    $("#zoom img").src = image.source;
    $("#zoom").showModal();
  });
  return button;
}

function nothing() {
  const box = document.createElement("div");
  box.className = "none";
  box.textContent = "no picture";
  return box;
}

// What is clicked

for (const button of $$("button.set")) button.addEventListener("click", () => chooseSet(button.dataset.set));
for (const heading of $$("#table thead [aria-sort]")) {
  heading.firstElementChild.addEventListener("click", () => {
    sortBy(heading);
    showPictures();
  });
}
for (const box of $$("#table tbody input")) {
  box.addEventListener("change", () => {
    shown[box.closest("tr").dataset.row] = box.checked;
    showCurves();
    showPictures();
  });
}
for (const link of $$("#table tbody a")) {
  link.addEventListener("click", () => { $(link.getAttribute("href")).open = true; });
}
$("#details").addEventListener("change", showCurves);
$("#log").addEventListener("change", (event) => scaleLosses(event.target.checked ? "log" : "linear"));
for (const control of $$("#moment, #frame, #seed")) control.addEventListener("input", showPictures);
$("#zoom").addEventListener("click", (event) => { if (event.target === $("#zoom")) $("#zoom").close(); });

chooseSet("0");
drawCurves();
showPictures();
