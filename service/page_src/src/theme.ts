// Light, dark, or as the system says; remembered by the browser.

export type Theme = "auto" | "light" | "dark";

export function theme(): Theme {
  const kept = localStorage.getItem("theme");
  return kept === "light" || kept === "dark" ? kept : "auto";
}

export function nextTheme(now: Theme): Theme {
  return now === "auto" ? "dark" : now === "dark" ? "light" : "auto";
}

export function setTheme(wanted: Theme): void {
  localStorage.setItem("theme", wanted);
  if (wanted === "auto") delete document.documentElement.dataset["theme"];
  else document.documentElement.dataset["theme"] = wanted;
}
