import { Player, open } from "pd4-player";
import { SceneSource } from "pd4-player/fetch";

const canvas = document.querySelector("canvas") as HTMLCanvasElement;
const player: Player = open(new URL("scene.pd4", location.href), { canvas });
player.addEventListener("firstpicture", () => { document.title = "drawn"; });
Object.assign(globalThis, { player, SceneSource });
